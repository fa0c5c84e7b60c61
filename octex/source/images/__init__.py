"""Images: files decoded to texels, levels of them stored, footprints read by the filters of the field."""
