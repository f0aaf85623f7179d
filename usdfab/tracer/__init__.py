"""The Embree two-scale path tracer."""

from usdfab.tracer.render import Render as Render, RenderSettings as RenderSettings, Tracer as Tracer
