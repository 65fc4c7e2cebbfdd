"""The simulated city of one seed: streets, buildings, traffic and people.

`city` has the streets and blocks with which everything else is placed, `simulation` the actors over a whole drive.
"""
