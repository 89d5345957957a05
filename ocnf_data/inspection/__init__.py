"""Looking at a data set: pictures of samples, statistics, and whether its values are physically right."""
