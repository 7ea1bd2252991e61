"""From a scene and a camera's way to a picture and its depth."""
