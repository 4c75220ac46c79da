# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Limits of what is read of a file, whatever it declares."""

from __future__ import annotations

# Bytes of a chunk, or of one message outside of chunks; --max-chunk changes it.
LARGEST_CHUNK = 256 << 20

# Bytes that zstd may hold back while it expands a stream: its strongest level needs them.
LARGEST_WINDOW = 128 << 20

# Largest expanded size of a file: a multiple of its own size, or a gigabyte if that is more.
MOST_EXPANSION = 1000
UNSUSPICIOUS = 1 << 30
# Messages that any file may hold; a larger one as many as it has bytes, since even compressed the
# time of each takes more.
MOST_MESSAGES = 4_000_000
# Steps of SQLite's machine that any file may take, and further ones for each of its bytes: a row
# of a few bytes takes some twenty.
MOST_STEPS_OF_SQLITE = 1_000_000
STEPS_OF_SQLITE_PER_BYTE = 5
# Bytes of the disk that stay free.
FREE_DISK = 256 << 20

# Bytes of the definition of a message type: the largest of the common interfaces has 20 kB.
LARGEST_DEFINITION = 256 << 10

# Types without a definition in the file that are looked for among the installed packages.
MOST_SOUGHT = 1000

# Bytes of the definitions of a file that are read.
MOST_DEFINITIONS = 8 << 20

# Structures and elements of lists in the messages of a topic that are decoded whole, as those of
# relay_node are.
MOST_ELEMENTS = 200_000

# Types within types, and fields of all of them together.
DEEPEST_TYPE = 40
MOST_FIELDS = 5_000

# Fields, and elements of arrays of unequal size, that are passed on the way to a field.
MOST_STEPS = 5_000

# Bytes of the index at the end of a file.
LARGEST_SUMMARY = 256 << 20

# Topics of one number among which measurement and command are looked for: each pair is one try.
MOST_SEARCHED = 1000

# Messages of a topic for which memory is set aside because the file says that it has them.
MOST_EXPECTED = 1 << 27

# Records of a file that declare something, their bytes, and notes on what is wrong in a file.
MOST_DECLARATIONS = 50_000
MOST_DECLARED = 64 << 20
MOST_NOTES = 20

# Largest value of a quantity of a process, in any unit; its square does not overflow.
LARGEST_VALUE = 1e100

# Bytes of a text with columns, and characters of a line in it.
LARGEST_TEXT = 2 << 30
LONGEST_LINE = 1 << 20
