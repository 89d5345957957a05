"""A page to look at: one HTML file with statistics, a gallery and a 3-D view, which opens from the disk."""
