"""The set of live processes does not depend on the order of the messages about it."""

from hypothesis import given
from hypothesis import strategies as st

from swarm.peers import SILENCE_NS, Newest, Peer, Roster


def test_however_many_tokens_one_process_raises_only_its_newest_are_kept() -> None:
    roster = Roster()
    for incarnation in range(1000, 0, -1):
        roster.appeared(Peer("agent", "a0", incarnation))
    assert (len(roster._alive["agent", "a0"]), roster.alive("agent")) == (64, {"a0": 1000})
    for incarnation in range(1000, 0, -1):
        roster.gone(Peer("agent", "a0", incarnation))
    assert not roster.is_alive("agent", "a0")


peers = st.builds(Peer, st.sampled_from(["agent", "planner"]), st.sampled_from(["x", "y"]), st.integers(1, 3))


@given(st.lists(st.tuples(st.booleans(), peers), max_size=30))
def test_of_each_role_the_newest_incarnations_whose_tokens_are_up_are_alive(tokens: list[tuple[bool, Peer]]):
    """One may appear before the last one is gone, and tokens that repeat or were never up change nothing."""
    roster, up = Roster(), set[Peer]()
    for rises, peer in tokens:
        (roster.appeared if rises else roster.gone)(peer)
        (up.add if rises else up.discard)(peer)
        for role in ("agent", "planner"):
            alive = {each.id: each.incarnation for each in sorted(up) if each.role == role}
            assert list(roster.alive(role).items()) == list(alive.items())
            assert [id for id in "xy" if roster.is_alive(role, id)] == list(alive)
        assert roster.up() == sorted({(each.role, each.id) for each in up})


numbers = st.tuples(st.integers(0, 3), st.integers(0, 5))


@given(st.lists(numbers, min_size=1), st.randoms(use_true_random=False))
def test_without_a_silence_the_highest_number_counts_in_whatever_order_they_come(values, chance):
    newest, last = Newest(), None
    chance.shuffle(values)
    for number in values:
        if newest.is_news("t", number, 0):
            last = number
    assert last == max(values)


@given(st.lists(st.tuples(st.integers(0, (1 << 62) - 1), st.integers(0, (1 << 62) - 1)), max_size=20))
def test_after_a_silence_a_sender_that_goes_on_is_followed_whatever_was_heard_before(lies):
    newest, step_ns = Newest(), SILENCE_NS // 10
    for number in lies:
        newest.is_news("t", number, 0)
    heard = [newest.is_news("t", (1, seq), seq * step_ns) for seq in range(1, 15)]
    assert heard[-1]
    assert heard == sorted(heard), "once it is followed it stays so"


def test_no_single_message_outweighs_those_that_follow_for_longer_than_the_silence() -> None:
    newest = Newest()
    assert newest.is_news("t0", (7, 1), 0)
    assert not newest.is_news("t0", (7, 1), 1)
    assert newest.is_news("t0", (1 << 61, 5), 2)
    assert not newest.is_news("t0", (7, 2), 1 + SILENCE_NS)
    assert newest.is_news("t1", (7, 2), 3)


def test_streams_beyond_the_most_are_always_news_and_take_no_memory() -> None:
    newest = Newest(most=1)
    assert newest.is_news("a", (1, 1), 0)
    assert all(newest.is_news("b", (1, 1), 0) for _ in range(3))
