"""Kedro settings (https://docs.kedro.org)."""

import gc

from gyro_pipeline.hooks import Preflight, Provenance
from gyro_pipeline.session import OWN_SETTINGS, Context, Session

gc.set_threshold(100_000)
"""A command makes millions of objects that stay; collecting them took a quarter of its time."""

SESSION_CLASS = Session
CONTEXT_CLASS = Context
HOOKS = (Preflight(), Provenance())

CONFIG_LOADER_ARGS = {
    "base_env": "base",
    "default_run_env": "local",
    # Environments hold differences only, at any depth.
    "merge_strategy": {"parameters": "soft", "globals": "soft"},
    "custom_resolvers": {OWN_SETTINGS: str},  # a context replaces it in a run with --params
}
