"""Looking at fibers in a window or a picture. pyvista is loaded only when something is shown."""

from usdfab.view.inspect import fiber_scene as fiber_scene
from usdfab.view.inspect import render as render
from usdfab.view.inspect import screenshot as screenshot
from usdfab.view.inspect import show as show
