"""`sgns train`: windows, loss, validation, and the fit of polynomials."""
