"""The simulated city: streets, traffic and people."""
