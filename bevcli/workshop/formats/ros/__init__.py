"""MCAP files and ROS 2 bags as sequences. Needs the extra `bevcli[ros]`, but no ROS installation.

sequence: the frames of a bag, and decoding image messages and video packets.
bag: the files of one recording as topics with indexed messages; the topics of each camera.
storage: MCAP and SQLite, and the bytes of a message -> its fields. messages: these fields -> this package's types.
vehicle: the rig, poses on demand, from a topic or from transforms, and the place on Earth.
"""
