"""Cameras: captures that know one kind of source, and the two ways to take frames from them.

A source that does not wait (V4L2, HTTP stream) is drained by a thread in ``live``; one that does (image
sequence, video file) gives every frame in order in ``recorded``.
"""
