"""A batch of grid-octrees as tensors: structure, leaves, neighbour tables, resampling."""
