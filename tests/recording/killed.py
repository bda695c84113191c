#!/usr/bin/env python3
"""Reads recordings whose recorder was killed with the Python package `mcap`, as far as they go.

For each it prints one JSON object on a line: the messages, and when the last of them came.

    python3 tests/recording/killed.py FILE.mcap...

Exit status: 0 read, 1 something is wrong, 77 the package is missing (pip install mcap).
"""

import json
import sys

try:
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader
except ImportError as problem:
    print(f"skipped: {problem} (pip install mcap)")
    sys.exit(77)


def read(path):
    messages, last_ns = 0, 0
    with open(path, "rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        try:
            for _schema, _channel, message in reader.iter_messages(log_time_order=False):
                messages += 1
                last_ns = max(last_ns, message.log_time)
        except EndOfFile:
            # After a kill the file has no end.
            pass
    return {"messages": messages, "last_ns": last_ns}


for path in sys.argv[1:]:
    print(json.dumps(read(path)))
