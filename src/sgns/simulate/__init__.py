"""`sgns simulate`: scenes and campaigns of them, with the material point method."""
