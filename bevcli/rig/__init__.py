"""Diagnosis of a calibration: the checks, their findings, and the sheet and recording of a rig."""
