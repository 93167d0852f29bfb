"""Collects the tracks of several running pipelines in one SQLite database, with asyncio.

    catstream track 0 --box 120,80,64,48 --set run.endpoint=door
    catstream track rtsp://10.0.0.7/stream1 --box 300,90,60,150 --set run.endpoint=yard
    python examples/asyncio_collector.py tracks.sqlite door yard

Rows are stored once a second, and other programs can read them meanwhile:

    sqlite3 tracks.sqlite "SELECT pipeline, object, max(frame) FROM tracks GROUP BY pipeline, object"

It ends with the last pipeline, or with Ctrl-C. A pipeline may start later, and one that fails does not end the others.
"""

from __future__ import annotations

import asyncio
import sqlite3
import sys
from contextlib import closing, suppress

import catstream

TABLE = """
CREATE TABLE IF NOT EXISTS tracks (
    pipeline TEXT NOT NULL, object TEXT NOT NULL, frame INTEGER NOT NULL, seconds REAL NOT NULL, state TEXT NOT NULL,
    x REAL, y REAL, w REAL, h REAL, score REAL NOT NULL
)
"""


async def collect(pipeline: str, database: sqlite3.Connection) -> None:
    """Insert the tracks of a pipeline until it ends."""
    count = 0
    try:
        with catstream.subscribe(pipeline, "tracks") as tracks:
            async for track in tracks:
                box = track.box or (None, None, None, None)
                row = (pipeline, track.object, track.frame, track.time, track.state, *box, track.score)
                database.execute("INSERT INTO tracks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
                count += 1
            reason = tracks.end.reason if tracks.end else "no end"
            print(f"{pipeline}: {count} tracks, {tracks.losses()}: {reason}", flush=True)
    except catstream.CatstreamError as error:
        print(f"{pipeline}: {count} tracks: {error}", flush=True)


async def store(database: sqlite3.Connection) -> None:
    """Commit once a second."""
    while True:
        await asyncio.sleep(1)
        database.commit()


async def main(path: str, *pipelines: str) -> None:
    """Collect until the last pipeline has ended."""
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode=WAL")  # a reader and the collector do not wait for each other
        database.execute(TABLE)
        committing = asyncio.create_task(store(database))
        try:
            await asyncio.gather(*(collect(pipeline, database) for pipeline in pipelines))
        finally:  # also after Ctrl-C
            committing.cancel()
            database.commit()


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python asyncio_collector.py DATABASE ENDPOINT [ENDPOINT ...]")
    with suppress(KeyboardInterrupt):
        asyncio.run(main(*sys.argv[1:]))
