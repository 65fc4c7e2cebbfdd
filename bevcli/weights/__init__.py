"""Weights by name: `cache` (where they lie), `download` (HTTP), `fetch` (checks).

Only `fetch` connects to another machine, and only where it is called. `demo.safetensors` are the weights of the demo.
"""
