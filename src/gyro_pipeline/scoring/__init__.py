"""How estimates are judged: which truth, which error, which figure of merit with which interval."""
