"""The recording session: a plan of poses, devices that carry it out, a log of what happened."""
