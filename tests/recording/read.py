#!/usr/bin/env python3
"""Reads a recording with independent programs: the Python packages `mcap` and `mcap-protobuf-support`.

It decodes every message, compares the types with those of Foxglove's own package, looks for a picture with the stamp of
each overlay, counts the drawings of a report, and prints the result as one JSON object on the last line.

    python3 tests/recording/read.py FILE.mcap [FOLDER OF FIGURES]

Exit status: 0 read, 1 something is wrong, 77 a package is missing
(pip install mcap mcap-protobuf-support foxglove-schemas-protobuf).
"""

import collections
import importlib
import json
import sys
import xml.etree.ElementTree
from pathlib import Path

try:
    from google.protobuf import descriptor_pb2
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader, make_reader
    from mcap.records import Attachment, Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader
    from mcap_protobuf.decoder import DecoderFactory

    import foxglove_schemas_protobuf  # noqa: F401
except ImportError as problem:
    print(f"skipped: {problem} (pip install mcap mcap-protobuf-support foxglove-schemas-protobuf)")
    sys.exit(77)


def check_types(schema):
    """Each field of our types has name, number, type and label of Foxglove's own."""
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    for file in files.file:
        for ours in file.message_type:
            if file.package != "foxglove":
                continue
            module = importlib.import_module(f"foxglove_schemas_protobuf.{ours.name}_pb2")
            theirs = descriptor_pb2.DescriptorProto()
            getattr(module, ours.name).DESCRIPTOR.CopyToProto(theirs)
            fields = {f.name: (f.number, f.type, f.label, f.type_name) for f in theirs.field}
            for f in ours.field:
                field = (f.number, f.type, f.label, f.type_name)
                if fields.get(f.name) != field:
                    sys.exit(f"{ours.name}.{f.name} is {field}, Foxglove's is {fields.get(f.name)}")
            enums = {e.name: [(v.name, v.number) for v in e.value] for e in theirs.enum_type}
            for e in ours.enum_type:
                values = [(v.name, v.number) for v in e.value]
                if enums.get(e.name) != values:
                    sys.exit(f"{ours.name}.{e.name} is {values}, Foxglove's is {enums.get(e.name)}")


def nanoseconds(stamp):
    return stamp.seconds * 10**9 + stamp.nanos


def is_drawing(path):
    """Whether a file is a complete SVG with at least one shape."""
    root = xml.etree.ElementTree.parse(path).getroot()
    svg = "{http://www.w3.org/2000/svg}"
    return root.tag == f"{svg}svg" and any(root.iter(f"{svg}{kind}") for kind in ("polyline", "polygon", "circle"))


def main(path, figures):
    counts, files, metadata = collections.Counter(), {}, {}
    schemas, channels, decoders = {}, {}, {}
    pictures, overlays, lines = set(), [], []
    is_ended = True
    last_ns = 0
    factory = DecoderFactory()
    with open(path, "rb") as file:
        records = StreamReader(file, validate_crcs=True).records
        while True:
            try:
                record = next(records)
            except StopIteration:
                break
            except EndOfFile:
                is_ended = False
                break
            if isinstance(record, Schema):
                schemas[record.id] = record
                if record.encoding == "protobuf":
                    check_types(record)
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Attachment):
                files[record.name] = len(record.data)
            elif isinstance(record, Metadata):
                metadata[record.name] = record.metadata
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                counts[channel.topic] += 1
                last_ns = max(last_ns, record.log_time)
                if channel.message_encoding == "json":
                    json.loads(record.data)
                elif channel.message_encoding == "protobuf":
                    if channel.id not in decoders:
                        schema = schemas[channel.schema_id]
                        decoders[channel.id] = factory.decoder_for("protobuf", schema)
                    message = decoders[channel.id](record.data)
                    if channel.topic.endswith("/picture"):
                        pictures.add(nanoseconds(message.timestamp))
                    elif channel.topic.endswith("/overlay"):
                        overlays.extend(nanoseconds(t.timestamp) for t in message.texts)
                    elif channel.topic == "log":
                        lines.append(message.message)
    with open(path, "rb") as file:
        # The reader that most programs use: with the index where there is one. It takes a file without an end only as a
        # stream, in the order of the file.
        reader = make_reader(file, validate_crcs=True) if is_ended else NonSeekingReader(file, validate_crcs=True)
        indexed = 0
        try:
            for _ in reader.iter_messages(log_time_order=is_ended):
                indexed += 1
        except EndOfFile:
            pass
    print(
        json.dumps(
            {
                "is_ended": is_ended,
                "messages": sum(counts.values()),
                "indexed": indexed,
                "channels": dict(sorted(counts.items())),
                "files": files,
                "metadata": metadata,
                "overlays": len(overlays),
                "overlays_with_picture": sum(stamp in pictures for stamp in overlays),
                "log": lines,
                "last_ns": last_ns,
                "figures": sum(is_drawing(path) for folder in figures for path in Path(folder).glob("*.svg")),
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
