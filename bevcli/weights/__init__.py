"""Files of weights: the demo's own (`demo.safetensors`), where others are published (`sources.toml`), and downloads.

Only `fetch` connects to another machine, and only where it is called.
"""
