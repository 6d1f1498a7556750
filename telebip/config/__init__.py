"""Typed task configuration: YAML file (and its base) -> command-line overrides -> one validated `TaskConfig`.

`schema` names every field, its type, its unit and its bounds, terms name their parameters themselves (`telebip.mdp.term`), and
the numbers stand in `configs/`. `tree` reads and merges YAML, `validation` makes a dataclass of it, `loading` joins them.
Whatever a user gets wrong is a `UserError` that names the field, the file and line (or the override) and what would be valid.
"""

from telebip.config.loading import CONFIGS, check, load, load_task, parse_config, study_names, task_names, to_yaml
from telebip.config.schema import ObservationGroup, TaskConfig

__all__ = [
    "CONFIGS",
    "ObservationGroup",
    "TaskConfig",
    "check",
    "load",
    "load_task",
    "parse_config",
    "study_names",
    "task_names",
    "to_yaml",
]
