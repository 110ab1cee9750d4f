"""What people are shown of a run, made in one place.

The live table, the live view, `swarm status` and the report draw from `RunState`, and from nothing else:

    messages -> Observed -> RunState -> text of a fact

plan.py    what the run should be: its targets, its processes, when it began
state.py   `RunState`: what it is at an instant. `StateMaker.state` makes one
facts.py   `FACTS` and `TARGET_FACTS`: name, label, unit, text and meaning of each fact
alarms.py  `Alarm` and `KINDS`: what went wrong, where, since when, and whether it is over

A new fact is one row in `FACTS`, and appears everywhere. Facts are counted by whoever does what is counted, and a
process that is started again goes on counting where it ended (`swarm.runtime.stats.carried`). So all who watch
agree once messages have arrived, whenever they began to watch.
"""
