"""MCAP files and ROS 2 bags as sequences. Needs the extra `bevcli[ros]`, but no ROS installation.

sequence: RosSequence, a bag as a Sequence.
bag: Bag, the files of one recording as topics with indexed messages. storage: MCAP and SQLite.
messages: the bytes of a message -> its fields -> this package's types.
topics: the topics of each camera, found or stated in a TOML file.
ego_motion: poses on demand, from a topic or from transforms; the place on Earth.
images: decoding image messages and video packets.
"""
