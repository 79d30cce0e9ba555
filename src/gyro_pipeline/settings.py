"""Kedro settings (https://docs.kedro.org)."""

from gyro_pipeline.hooks import Preflight, Provenance, Session

SESSION_CLASS = Session
HOOKS = (Preflight(), Provenance())

CONFIG_LOADER_ARGS = {
    "base_env": "base",
    "default_run_env": "local",
    # Environments hold differences only, at any depth.
    "merge_strategy": {"parameters": "soft", "globals": "soft"},
}
