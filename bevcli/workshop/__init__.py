"""The workshop: what stands beside a run, in wings. Each is found by `registered.py`; the core does not know them."""
