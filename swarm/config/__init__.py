"""The settings of a run: a scenario is read once, checked, frozen, and handed down by section.

- `scenario`, `ground` and `vehicle_classes` declare every setting: its unit in its name, its range in its type, its
  meaning as a row of its section's docstring. `scenario` plans the agent processes, too. `setting_types` has the
  types that several share.
- `scenario_files` makes a `Scenario` of TOML, and TOML of a `Scenario`: size and nesting are bounded before
  anything is parsed (`input_files`), presets and costs of classes are filled in (`vehicle_classes`), msgspec checks
  types and ranges, and last come the rules about several settings (`contradictions`).
- `explain` turns msgspec's errors into sentences: file, key, the value found, the values allowed, and a near name.
- `plugin_names` knows which settings name a plug-in.

All errors are `ConfigError`, one sentence each. `read_scenario` finds as many as it can at once.
"""
