"""The agent: hosts vehicles, drives them along the routes of planners, and marks what they find.

`assemble` makes the parts, `AgentService` carries messages between them and the bus, and `Agent` is the core: it
takes messages and time, and returns what to ask of planners. It knows no network and no thread. Nothing here needs
numba, so that the process starts quickly.
"""
