"""The report: the paper's tables and figures, from tracked runs and recordings alone."""
