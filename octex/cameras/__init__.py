"""Cameras and their files.

camera         a picture's size, lens and pose
lens           lens distortion
differentials  how the point that a pixel sees moves from pixel to pixel
files          cameras read and written, whatever the format
frames         the cameras of a file, with the names of their pictures
fields         fields of records: read, checked, and named in errors
others         one file a format; sfm: those of structure from motion
"""
