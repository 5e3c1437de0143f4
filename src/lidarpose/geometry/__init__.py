"""Geometry without units of its own: poses, lines, planes, circles and robust fits on plain arrays."""
