"""MCAP files and ROS 2 bags as sequences. Needs the extra `bevcli[ros]`, but no ROS installation.

sequence: RosSequence, a bag as a Sequence.
bag: Bag, the files of one recording as topics with indexed messages. mcap_file and sqlite_file: its storage formats.
decoding: the bytes of a message -> its fields (CDR, JSON, Protobuf). messages: the fields -> this package's types.
topics: which topic belongs to which camera. topics_file: the TOML that states it.
transforms: the tree of static transforms. ego_motion: poses on demand.
images, packets: decoding image messages and video packets.
"""
