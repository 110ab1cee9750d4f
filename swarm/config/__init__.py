"""The settings of a run: a scenario is read once, checked, frozen, and handed down by section.

- `scenario`, `ground` and `vehicle_classes` declare every setting: its unit in its name, its range in its type, its
  meaning as a row of its section's docstring. `setting_types` has the types that several share.
- `load` makes a `Scenario` of TOML: size and nesting are bounded before anything is parsed (`input_files`), presets
  and costs of classes are filled in (`cost_rules`), msgspec checks types and ranges, and last come the rules about
  several settings.
- `explain` turns msgspec's errors into sentences: file, key, the value found, the values allowed, and a near name.
- `write` is the way back to TOML, which `load` reads as the same scenario.
- `plugin_names` knows which settings name a plug-in, and `agent_plan` which processes a scenario needs.

All errors are `ConfigError`, one sentence each. `read_scenario` finds as many as it can at once.
"""
