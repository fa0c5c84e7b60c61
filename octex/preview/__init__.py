"""Pictures for people: a model as its source and as its octree colours it, and where they differ."""

from octex.preview.differences import draw_difference as draw_difference
from octex.preview.differences import write_difference as write_difference
from octex.preview.directions import Viewpoint as Viewpoint
from octex.preview.directions import viewpoint_among as viewpoint_among
from octex.preview.panels import draw_preview as draw_preview
from octex.preview.panels import write_preview as write_preview
from octex.preview.pictures import render as render
from octex.preview.pictures import render_leaves as render_leaves
from octex.preview.shaders import Bump as Bump
from octex.preview.shaders import source_shader as source_shader
from octex.preview.shaders import texture_shader as texture_shader
