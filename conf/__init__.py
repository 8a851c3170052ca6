"""Settings of every command (Hydra); installed as ``sgns.conf`` and read as ``pkg://sgns.conf``."""
