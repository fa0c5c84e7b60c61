"""Cameras, and the files that store them.

camera         image size, lens and pose
lens           lens distortion
differentials  derivatives of the visible surface point by pixel position
files          reads and writes cameras of any supported format
frames         the cameras of one file, with the names of their images
fields         reads and checks the fields of a record, and names them in errors
others         one module a format; sfm: the formats of structure from motion
"""
