"""Renders models and textures in any light, and maps of their differences."""

from octex.drawing.compare import difference as difference
from octex.drawing.differences import draw_difference as draw_difference
from octex.drawing.directions import Viewpoint as Viewpoint
from octex.drawing.directions import camera_of as camera_of
from octex.drawing.directions import viewpoint_among as viewpoint_among
from octex.drawing.environment import Environment as Environment
from octex.drawing.panels import draw_preview as draw_preview
from octex.drawing.panels import write_png as write_png
from octex.drawing.panels import write_preview as write_preview
from octex.drawing.rasters import render_leaves as render_leaves
from octex.drawing.rasters import render_surface as render_surface
from octex.drawing.shaders import source_shader as source_shader
from octex.drawing.shaders import texture_shader as texture_shader
from octex.drawing.views import as_png as as_png
from octex.drawing.views import draw_paintable as draw_paintable
from octex.drawing.views import render as render
