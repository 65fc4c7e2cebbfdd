"""The facts about an installation and its machine, to paste into an issue."""
