"""Weights by name: `sources` (where they are published), `cache` (where they lie), `download` (HTTP), `fetch` (checks).

Only `fetch` connects to another machine, and only where it is called. `demo.safetensors` are the weights of the demo.
"""
