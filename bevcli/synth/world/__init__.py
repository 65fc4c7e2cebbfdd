"""The simulated city of one seed: streets, buildings, traffic and people.

city          streets and blocks; everything else is placed with it
ground_plan   what is painted on the ground
buildings, scenery
              objects without annotations
roadside      annotated objects that stand still: parked vehicles, road works, building sites, people
route, signals, traffic, spawning
              vehicles that drive
pedestrians   people who walk
actors        the state of an annotated object at a time
simulation    traffic and pedestrians over the whole drive, and the ego vehicle's motion
weather       sun, sky and haze
"""
