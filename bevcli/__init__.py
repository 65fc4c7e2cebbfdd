"""bevcli: run BEVFormer on sequences from any camera rig, and see what it sees."""

__version__ = "0.1.0"
