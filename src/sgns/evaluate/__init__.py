"""`sgns evaluate`: a trained simulator against true runs."""
