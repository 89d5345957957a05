"""The streaming loader (`dataset.py`) and its parts; only `dataset.py` and `batch.py` know torch."""
