"""Recordings, pictures and videos of what the model sees."""
