"""Typed task configuration: YAML file (and its base) -> command-line overrides -> one validated `TaskConfig`.

`schema` names every field, its type, its unit and its bounds; their numbers stand in `configs/`; `loading` joins the two.
Whatever a user gets wrong is a `UserError` that names the field, the file and line (or the override) and what would be valid.
"""

from telebip.config.loading import CONFIGS, load, load_task, parse_config, task_names, to_yaml
from telebip.config.schema import TaskConfig, quantity, section

__all__ = ["CONFIGS", "TaskConfig", "load", "load_task", "parse_config", "quantity", "section", "task_names", "to_yaml"]
