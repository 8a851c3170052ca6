"""A local page that shows a run, or lets a person drive a tool through the soil of a network."""
