"""The status page: snapshots of the station enter; JSON, map messages and the page's files are served to browsers.

    page = serve(*address("127.0.0.1:8080"), lambda: latest)
    ... in the loop that steps the station:
    latest = take_snapshot(station, now_ns, started_ns)

`server` has `serve` and `address`, and alone needs a web server: nothing is imported here, so that a base without one
answers `kiteline status`. A snapshot is frozen and the server's thread only reads it. A new number on the page is a
line in `numbers.py`.
"""
