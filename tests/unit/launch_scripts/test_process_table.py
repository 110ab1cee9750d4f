"""The processes that a launcher starts, their order, and the wait before a restart."""

from launch_scripts.launcher.local_processes import Running
from launch_scripts.launcher.run_options import chosen_processes
from launch_scripts.process_table import ROLES, STOP_ORDER, ProcessSpec, processes_of
from swarm.config.scenario import Scenario, StandbyConfig, TargetConfig
from swarm.config.scenario_files import parse_scenario


def test_the_table_has_standbys_after_those_that_lead_and_may_be_limited_to_a_rank() -> None:
    scenario = Scenario(targets=(TargetConfig(count=2),), standbys=StandbyConfig(planner=2, targets=1))
    roles = ("planner", "targets", "agent")

    def names(rank: int | None) -> list[str]:
        return [spec.name for spec in processes_of(scenario, roles, rank) if spec.role != "agent"]

    assert names(None) == [
        *("planner-t0", "planner-t1", "planner-t0.r1", "planner-t1.r1", "planner-t0.r2", "planner-t1.r2"),
        *("targets-0", "targets-0.r1"),
    ]
    assert names(0) == ["planner-t0", "planner-t1", "targets-0"]
    assert names(1) == ["planner-t0.r1", "planner-t1.r1", "targets-0.r1"]
    assert names(2) == ["planner-t0.r2", "planner-t1.r2"]
    assert names(3) == []
    assert len([spec for spec in processes_of(scenario, rank=1) if spec.role == "agent"]) == 4


def test_processes_are_chosen_by_role_and_id_and_start_in_order() -> None:
    scenario = parse_scenario('name = "x"\n[[targets]]\ncount = 2\n[standbys]\nplanner = 1')
    chosen = chosen_processes(scenario, ["agent", "planner.t1.r1", "router.3", "planner.t0", "planner.t0"], None)
    names = ["router-3", "planner-t1.r1", "planner-t0", "agent-a0", "agent-a1", "agent-a2", "agent-a3"]
    assert [spec.name for spec in chosen] == names


def test_the_referee_watches_also_where_someone_else_tracks_all_targets() -> None:
    scenario = Scenario(targets=(TargetConfig(walk="external"),))
    assert "targets-0" in [spec.name for spec in processes_of(scenario)]


def test_the_router_starts_first_and_ends_last() -> None:
    assert ROLES[0] == STOP_ORDER[-1] == "router"
    assert sorted(ROLES) == sorted(STOP_ORDER)


def test_the_wait_before_a_restart_doubles_to_five_seconds_and_is_short_again_after_a_good_run() -> None:
    running = Running(ProcessSpec("planner", "t0"))
    assert [running.crashed(ran_s=0.0) for _ in range(7)] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    assert running.crashed(ran_s=60.0) == 0.2
