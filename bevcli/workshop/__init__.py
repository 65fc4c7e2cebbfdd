"""The workshop: what stands beside a run, in wings. The core imports one in a function that needs it."""
