"""The parts of the streaming loader; all but `batch.py` know nothing of torch (see `ocnf_data.loader`)."""
