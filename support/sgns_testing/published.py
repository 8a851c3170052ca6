"""TFRecords as the paper's authors published them, written without TensorFlow."""

import numpy as np


def varint(n):
    out = b""
    while n > 127:
        out += bytes([n & 127 | 128])
        n >>= 7
    return out + bytes([n])


def field(number, content):
    return varint(number << 3 | 2) + varint(len(content)) + content


def feature(raw):
    return field(1, field(1, raw))


def record(frames, types, force, contexts=None):
    entry = lambda key, value: field(1, field(1, key.encode()) + field(2, value))  # noqa: E731
    context = entry("particle_type", feature(np.asarray(types, "<i8").tobytes())) + entry(
        "key", field(3, field(1, b""))
    )
    series = lambda rows: b"".join(field(1, feature(np.asarray(r, "<f4").tobytes())) for r in rows)  # noqa: E731
    lists = entry("position", series(frames)) + entry("force", series(force))
    if contexts is not None:
        lists += entry("step_context", series(contexts))
    return field(1, context) + field(2, lists)
