"""Arrays in, arrays out: undistort, grey, denoise, extract, triangulate; pipeline.py meets the store."""
