"""How fast a model runs here, stage by stage, beside what the machine could do at most."""
