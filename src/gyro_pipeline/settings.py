"""Kedro settings (https://docs.kedro.org)."""

import gc

from gyro_pipeline.hooks import Preflight, Provenance
from gyro_pipeline.session import OWN_SETTINGS, Context, Session

gc.set_threshold(100_000)
"""A command creates millions of long-lived objects; at the default threshold, garbage collection
took a quarter of its time."""

SESSION_CLASS = Session
CONTEXT_CLASS = Context
HOOKS = (Preflight(), Provenance())

CONFIG_LOADER_ARGS = {
    "base_env": "base",
    "default_run_env": "local",
    # Environments contain differences only, at any depth.
    "merge_strategy": {"parameters": "soft", "globals": "soft"},
    "custom_resolvers": {OWN_SETTINGS: str},  # the context of a run replaces it
}
