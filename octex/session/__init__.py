"""A painting session: runs the commands of browser pages with a `Painter`; undo, recovery and saving.

commands    parses and checks commands
journal     writes commands to disk before they run
outside     files that other programs may change meanwhile
material    strokes that paint several channels, and added channels
poses       the surface as posed or unwrapped, to paint on
painting    the session: runs commands on a thread of its own; undo, redo and saving
"""
