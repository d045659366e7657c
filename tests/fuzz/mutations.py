"""Changes that keep most of a text or of a picture as it is."""

import random
import re
import zlib

HOSTILE = [
    b"nan", b"inf", b"-inf", b"1e400", b"-1e308", b"1e-400", b"0", b"-0.0", b"-1",
    b"9223372036854775807", b"-9223372036854775808", b"18446744073709551616", b"4294967296",
    b"2147483648", b"9" * 400, b"0x" + b"f" * 300, b"1:2:3:4", b"0.1.2", b"1_000", b"", b" ",
    b"\0", b"\xff", b"\xef\xbb\xbf", b"\xed\xa0\x80", "\u0661".encode(), "\u2028".encode(), b"\r",
    b"\n", b"#", b",", b'"', b"'", b"{", b"[", b"[" * 200, b"null", b"true", b"~", b"*a", b"&a",
    b"<<", b"!!int ''", b"!!bool x", b"!!timestamp x", b"2024-99-99", b"../../x", b"/dev/zero",
]  # fmt: skip
"""What text files hold where somebody means harm, or a program was interrupted."""

_TOKEN = re.compile(rb"[^\s,:\[\]{}\"=]+")


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """Change a token, a line or a byte of a text, once or a few times."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        change = rng.choice((_token, _token, _token, _line, _bytes))
        data = change(data, rng)
    return data


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Change bytes, once or a few times."""
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        data = _bytes(data, rng)
    return data


def mutate_behind_first(data: bytes, rng: random.Random) -> bytes:
    """Change a text, not the byte before it that chooses what it stands for."""
    return data[:1] + mutate_text(data[1:], rng)


def mutate_picture(data: bytes, rng: random.Random) -> bytes:
    """Change bytes behind the two that choose; mend the checksums of a PNG, half of the time."""
    data = data[:2] + mutate_bytes(data[2:], rng)
    return data[:2] + _mended(data[2:]) if rng.random() < 0.5 else data


def _token(data: bytes, rng: random.Random) -> bytes:
    tokens = list(_TOKEN.finditer(data))
    if not tokens:
        return data + rng.choice(HOSTILE)
    token = rng.choice(tokens)
    new = rng.choice(HOSTILE) if rng.random() < 0.7 else rng.choice(tokens)[0]
    return data[: token.start()] + new + data[token.end() :]


def _line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    first, second = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(4)
    if kind == 0:
        lines.insert(first, lines[second])
    elif kind == 1:
        del lines[first]
    elif kind == 2:
        lines[first], lines[second] = lines[second], lines[first]
    else:
        lines[first] = lines[first][: rng.randrange(len(lines[first]) + 1)]
    return b"\n".join(lines)


def _bytes(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return bytes([rng.randrange(256)])
    at = rng.randrange(len(data))
    n_bytes = min(rng.choice((1, 1, 2, 4, 8)), len(data) - at)
    kind = rng.randrange(6)
    if kind == 0:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:
        value = rng.choice((0, 1, 127, 128, 255))
        return data[:at] + bytes([value]) * n_bytes + data[at + n_bytes :]
    if kind == 2:
        return data[:at] + rng.randbytes(n_bytes) + data[at + n_bytes :]
    if kind == 3:
        return data[:at] + data[at + n_bytes :]
    if kind == 4:
        return data[:at] + data[at : at + n_bytes] + data[at:]
    return data[:at] if rng.random() < 0.3 else data[:at] + rng.randbytes(n_bytes) + data[at:]


def _mended(data: bytes) -> bytes:
    """Return a PNG whose chunks have the checksums of what is in them; others as they are."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return data
    mended, position = bytearray(data[:8]), 8
    while position + 12 <= len(data):
        size = int.from_bytes(data[position : position + 4], "big")
        if position + 12 + size > len(data):
            break
        content = data[position + 4 : position + 8 + size]
        mended += data[position : position + 4] + content
        mended += zlib.crc32(content).to_bytes(4, "big")
        position += 12 + size
    return bytes(mended) + data[position:]
