"""A laboratory in software: scenes of painted panels, rendered by a ray tracer, with their exact truth.

Independent of what it is used to test: it knows the camera's projection and nothing of detection or estimation.
"""
