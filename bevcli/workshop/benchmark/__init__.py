"""The speed of a model on this machine, stage by stage, next to the machine's peak throughput."""
