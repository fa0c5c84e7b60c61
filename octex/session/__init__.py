"""A session of painting: what pages ask for, done in order with a `Painter`, undone, recovered and saved.

commands    what a page asks for, checked as it comes
journal     what pages sent, on the disk before it is done
material    several channels painted at once, and channels added
poses       the surface posed, or laid flat, for strokes on that
painting    the session: commands on a thread of their own; undo, redo and saving
"""
