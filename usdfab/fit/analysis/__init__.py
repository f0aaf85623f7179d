"""Classical analysis of one photo of woven cloth: counts, weave, colours, widths, gaps, twist, with confidences."""

from usdfab.fit.analysis.analyze import analyze_photo as analyze_photo
from usdfab.fit.analysis.result import PhotoAnalysis as PhotoAnalysis, YarnSystem as YarnSystem
