"""What is measured of a reconstruction beside its mean error: where the error lies, and the surface."""
