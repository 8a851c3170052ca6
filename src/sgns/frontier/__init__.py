"""What accuracy costs in time: operating points of the solver, of reductions and of surrogates on one scale."""
