"""Image pipelines: what lens, sensor, image processor and codec of other cameras make of the renderer's pictures."""
