"""A trained simulator against true runs: metrics, baselines, figures and the report."""
