"""Looking at fibers in a window or a picture. pyvista is loaded only when something is shown."""

from usdfab.view.inspect import fiber_scene as fiber_scene, render as render, screenshot as screenshot, show as show
