"""Values, documents, tables and wire formats: what the rest of turnscan agrees on.

Nothing here opens a file, and nothing here imports another turnscan package.
"""
