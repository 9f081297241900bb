"""Events of a fleet for readers that take them at different speeds."""

from hypothesis import given
from hypothesis import strategies as st

from fleet.live.monitor.async_bridge import HISTORY, MAX_WAITING, NEWEST_ONLY, EventFeed, ReaderBuffer


@given(
    st.lists(
        st.tuples(st.sampled_from(["state", "difficulty", "event", "result"]), st.sampled_from("ab")), max_size=60
    ),
    st.integers(0, 60),
)
def test_a_reader_gets_every_event_once_and_the_newest_state(said, after):
    """Taken in two helpings or one, in order: the letter box and the feed tell the same."""
    feed, box, got = EventFeed(), ReaderBuffer(), []
    for count, (topic, name) in enumerate(said):
        box.put(feed.add(topic, name, str(count)))
        if count == after:
            got += box.take()
    got += box.take()
    numbers = [entry.number for entry in got]
    assert numbers == sorted(set(numbers))
    events = [number for number, (topic, _) in enumerate(said, 1) if topic not in NEWEST_ONLY]
    assert [entry.number for entry in got if entry.topic not in NEWEST_ONLY] == events
    last = {where: number for number, where in enumerate(said, 1) if where[0] in NEWEST_ONLY}
    assert {(entry.topic, entry.name): entry.number for entry in got if entry.topic in NEWEST_ONLY} == last
    missed, gap = feed.since(0)
    assert not gap
    assert {entry.number for entry in missed} == {*events, *last.values()}


def test_bids_drop_no_event():
    feed, box = EventFeed(), ReaderBuffer()
    for topic in ("event", *["bid"] * (HISTORY + 1), "event"):
        box.put(feed.add(topic, "a", "{}"))
    missed, gap = feed.since(0)
    assert not gap
    assert [entry.topic for entry in missed] == [entry.topic for entry in box.take()] == ["event", "bid", "event"]


def test_a_full_reader_buffer_is_empty():
    feed, box = EventFeed(), ReaderBuffer()
    for _ in range(MAX_WAITING + 1):
        box.put(feed.add("event", "a", "{}"))
    assert box.full
    assert box.take() == []


def test_telemetry_never_fills_a_reader_buffer():
    feed, box = EventFeed(), ReaderBuffer()
    for number in range(10 * MAX_WAITING):
        box.put(feed.add("state", f"arm {number % 5}", "{}"))
    assert not box.full
    assert len(box.take()) == 5


def test_dropped_events_leave_a_gap():
    feed = EventFeed()
    for _ in range(1100):
        feed.add("event", "a", "{}")
    assert feed.since(10)[1]
    assert not feed.since(1000)[1]
    assert len(feed.since(1000)[0]) == 100
