"""Training data without end: samples made as they are needed, straight from a manifest.

    draw(seed, epoch, i) -> mesh or shape, rotation, scale | views, sigma, noise -> ground truth and input

`sources` lists what can be drawn, `draw` draws, `sample` makes octrees with generation's functions, `truths`
keeps ground truth that several epochs share, and `dataset` gives batches as `ShardDataset` does. Only the
last one knows torch.
"""
