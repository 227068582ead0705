"""What is said to many, on a key with wildcards, is not said of this stream."""

import struct
from contextlib import closing

import zenoh

from clients.cursors import Cursor, Cursors, Unknown
from clients.keys import StreamKeys
from clients.link import ScanLink, SessionSettings, open_session
from clients.outbox import OutboxSettings
from clients.publisher import ScanPublisher
from tests.clients.test_publisher import SCAN

KEYS = StreamKeys("gpom/v1/site", "r1", "laser")
FOR_MANY = ("gpom/v1/site/*/ack/laser", "gpom/v1/site/r1/ack/*", "gpom/v1/*/*/ack/**")


def test_an_acknowledgement_for_many_stores_nothing_and_supersedes_nobody(fake_map, caplog) -> None:
    outbox = OutboxSettings(silence_s=0.1)
    with ScanPublisher("r1", endpoints=[fake_map.endpoint], outbox=outbox) as robot:
        assert robot.durable(robot.publish(SCAN)).result(20.0) == 1, "it hears"
        fake_map.drop_every = 1  # what arrives now is not stored
        second, third = (robot.durable(robot.publish(SCAN)) for _ in range(2))
        for key in FOR_MANY:
            fake_map.session.put(key, struct.pack("<QQ", robot.boot, 3))
            fake_map.session.put(key, struct.pack("<QQ", robot.boot + 1, 3))
        fake_map.acknowledge("r1", robot.boot, 2)
        assert second.result(20.0) == 2
        assert (robot.waiting, third.done()) == (1, False)
        fake_map.acknowledge("r1", robot.boot, 3)
        assert third.result(20.0) == 3
    (warning,) = [record for record in caplog.records if record.name == "clients.cursors"]
    assert "on gpom/v1/site/*/ack/laser is not for gpom/v1/site/r1" in warning.getMessage()


def test_a_cursor_of_many_is_no_answer(silent_map) -> None:
    wild = "gpom/v1/site/*/cursor/laser"

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(wild, struct.pack("<QQ", 9, 9))
            if own:
                query.reply(KEYS.cursor, struct.pack("<QQ", *own[0]))

    own: list[Cursor] = []
    queryable = silent_map.session.declare_queryable(wild, answer)
    settings = SessionSettings([silent_map.endpoint])
    with open_session(settings) as session, closing(Cursors(session, KEYS, print)) as cursors:
        assert cursors.ask() is Unknown.MAP
        own.append(Cursor(5, 6))
        assert cursors.ask() == Cursor(5, 6)
    queryable.undeclare()


def test_a_sign_of_life_for_many_is_not_that_of_the_map(silent_map) -> None:
    silent_map.subscribe()
    many = silent_map.session.liveliness().declare_token("gpom/v1/**")
    settings = SessionSettings([silent_map.endpoint])
    with open_session(settings) as session, ScanLink(session, KEYS) as link:
        for _ in range(2):  # what is there already is told before the answer to a question is
            link.drain(10.0)
        assert not link.ready
        silent_map.appear()
        link.wait_ready(20.0)
        many.undeclare()
        for _ in range(2):
            link.drain(10.0)
        assert link.ready
