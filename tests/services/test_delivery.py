"""Laws of delivery: a message is given up only after the process was asked to end and its patience is over."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from catstream.services.delivery import Step, next_step

seconds = st.floats(0, 100)


@given(st.booleans(), st.booleans())
def test_while_nobody_asks_the_process_to_end_no_message_is_given_up(sent, stored):
    step = next_step(sent=sent, stored=stored, seconds_since_stop=float("-inf"), patience_seconds=0)
    assert step is (Step.SEND if not sent else Step.DONE if stored else Step.WAIT)


@given(st.booleans(), seconds, seconds)
def test_after_its_patience_a_message_that_is_not_stored_is_given_up(sent, patience, more):
    step = next_step(sent=sent, stored=False, seconds_since_stop=patience + more, patience_seconds=patience)
    assert step is Step.GIVE_UP


@given(seconds, seconds)
def test_a_message_that_is_stored_is_done_however_late(asked, patience):
    assert next_step(sent=True, stored=True, seconds_since_stop=asked, patience_seconds=patience) is Step.DONE


@given(st.lists(st.sampled_from(["taken", "stored", "asked"]), max_size=9), st.integers(0, 3))
def test_a_message_that_is_received_and_stored_within_the_time_limit_is_done(events, patience):
    sent = stored = False
    asked = -1
    for event in [*events, "taken", "stored"]:
        step = next_step(sent=sent, stored=stored, seconds_since_stop=asked, patience_seconds=patience)
        if step in (Step.DONE, Step.GIVE_UP):
            break
        sent |= event == "taken" and step is Step.SEND
        stored |= event == "stored" and sent
        asked += event == "asked"
    last = next_step(sent=sent, stored=stored, seconds_since_stop=asked, patience_seconds=patience)
    assert last is Step.GIVE_UP if asked >= patience and not stored else last in (Step.DONE, Step.WAIT)
