"""Arrays in, arrays out: undistort, grey, denoise, extract, triangulate.

pipeline.py is the one place here that meets the store.
"""
