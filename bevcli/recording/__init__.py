"""What goes into a rerun recording."""
