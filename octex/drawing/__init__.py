"""Pictures for people: a model as its source and as its octree colours it, and where they differ."""

from octex.drawing.differences import draw_difference as draw_difference
from octex.drawing.differences import write_difference as write_difference
from octex.drawing.directions import Viewpoint as Viewpoint
from octex.drawing.directions import viewpoint_among as viewpoint_among
from octex.drawing.panels import draw_preview as draw_preview
from octex.drawing.panels import write_preview as write_preview
from octex.drawing.pictures import render as render
from octex.drawing.pictures import render_leaves as render_leaves
from octex.drawing.shaders import Bump as Bump
from octex.drawing.shaders import source_shader as source_shader
from octex.drawing.shaders import texture_shader as texture_shader
