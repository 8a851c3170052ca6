"""The learned dynamics of the soil: what they are told, how they step, what a checkpoint holds."""
