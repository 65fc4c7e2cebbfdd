"""The class names of DDAD. docs/other-inputs.md says what is lost."""

# Names are compared without case; others, such as Wheeled Slow and Train, stay as they are, and are not scored.
CLASS_OF_NAME = {
    "Person": "pedestrian",
    "Pedestrian": "pedestrian",
    "Bus/RV/Caravan": "bus",
    "Towed Object": "trailer",
    "Caravan/RV": "truck",
}
