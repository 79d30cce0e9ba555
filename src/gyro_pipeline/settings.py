"""Kedro settings (https://docs.kedro.org)."""

from gyro_pipeline.hooks import OWN_SETTINGS, OwnReport, Preflight, Provenance, Session

SESSION_CLASS = Session
HOOKS = (Preflight(), OwnReport(), Provenance())

CONFIG_LOADER_ARGS = {
    "base_env": "base",
    "default_run_env": "local",
    # Environments hold differences only, at any depth.
    "merge_strategy": {"parameters": "soft", "globals": "soft"},
    "custom_resolvers": {OWN_SETTINGS: str},  # a hook replaces it in a run with --params
}
