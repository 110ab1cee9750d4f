"""One vehicle: its route, its motion, and its reaction to replies and to their absence.

`Vehicle` holds a vehicle's state and decides when it needs a route. `Follower` is its route while it is driven,
`Motion` its place between two cells. `Driver` moves the vehicles of an agent along the cells that they were
granted, in the time of a tick; `dynamics` computes how fast.

A vehicle is in one of eight states, which each report tells (`VehicleState`):

- IDLE: it has no target. Initial state, and the state after `release`.
- WAITING: it has a target and no route to it, and asks for one.
- FOLLOWING: it has a route to a target whose tracker is alive.
- ARRIVED: its target is within capture range and has a living tracker.
- STRANDED: no planner knows a way from here. It asks again every few seconds.
- LOST: its target's planner has ended. It drives on along the route that it has.
- OUTDATED: as FOLLOWING or ARRIVED, by the last pose of a target whose tracker is lost.
- SEARCHING: it has a route to a cell where its unseen target may be.

The state follows from known facts, in this precedence: capture range, ended planner, search, route
(`Vehicle._settle`). Only IDLE and STRANDED are stored; the others are derived. These are all transitions: the
method of `Vehicle` that is called, the states before it, and the state after it. Any other call changes no state.

    assign          ARRIVED, LOST, SEARCHING -> FOLLOWING
    assign          LOST, SEARCHING -> OUTDATED
    assign          ARRIVED, FOLLOWING, IDLE, LOST, OUTDATED, SEARCHING -> WAITING
    cut_route       FOLLOWING, OUTDATED -> WAITING
    give_route      SEARCHING, STRANDED, WAITING -> FOLLOWING
    give_route      SEARCHING, STRANDED, WAITING -> OUTDATED
    give_route      FOLLOWING, OUTDATED, STRANDED, WAITING -> SEARCHING
    give_route      FOLLOWING, OUTDATED, SEARCHING, STRANDED -> WAITING
    lose_planner    FOLLOWING, OUTDATED, SEARCHING, STRANDED, WAITING -> LOST
    no_answer       FOLLOWING, OUTDATED -> WAITING
    no_way          FOLLOWING, IDLE, OUTDATED, SEARCHING, WAITING -> STRANDED
    refuse_route    FOLLOWING, OUTDATED, SEARCHING, WAITING -> STRANDED
    refuse_route    FOLLOWING, OUTDATED -> WAITING
    regain_planner  LOST -> FOLLOWING
    regain_planner  LOST -> OUTDATED
    regain_planner  LOST -> SEARCHING
    regain_planner  FOLLOWING, LOST, OUTDATED -> WAITING
    release         ARRIVED, FOLLOWING, LOST, OUTDATED, SEARCHING, STRANDED, WAITING -> IDLE
    route_request   FOLLOWING, OUTDATED -> WAITING
    set_in_reach    FOLLOWING, LOST, SEARCHING, STRANDED, WAITING -> ARRIVED
    set_in_reach    ARRIVED -> FOLLOWING
    set_in_reach    ARRIVED, OUTDATED -> LOST
    set_in_reach    LOST, SEARCHING, STRANDED, WAITING -> OUTDATED
    set_in_reach    ARRIVED, OUTDATED -> SEARCHING
    set_in_reach    ARRIVED, FOLLOWING, OUTDATED -> WAITING
    set_tracked     OUTDATED -> ARRIVED
    set_tracked     OUTDATED -> FOLLOWING
    set_tracked     ARRIVED, FOLLOWING -> OUTDATED
    set_tracked     FOLLOWING, OUTDATED -> WAITING
    target_jumped   SEARCHING -> FOLLOWING
    target_jumped   SEARCHING -> OUTDATED
    target_jumped   FOLLOWING, OUTDATED, SEARCHING -> WAITING

`route_request`, `no_answer` and `refuse_route` lead to WAITING if a route has run out, because only these calls
notice that.
"""
