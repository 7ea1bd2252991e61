"""Image pipelines: effects of lens, sensor, image processor and codec of other cameras on rendered images."""
