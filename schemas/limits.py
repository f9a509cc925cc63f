"""How much a file from somebody else may ask for, checked before anything is allocated, decompressed or parsed.

A store, a results file or a grouping may come from anybody. A few hundred bytes can claim a petabyte, a hundred million
chunks or a megabyte of nested brackets. Every limit is far above what a capture writes, and says why it is as it is. A
number over one of them ends with a sentence and exit code 2.
"""

# Documents.

#: Bytes of a zarr.json, a seal or an index. The largest that a capture writes are the attributes of an episode: 10 MB
#: for a thousand replans with a prompt each. 32 MB of any text take less than 300 MB in memory.
DOCUMENT_BYTES = 32_000_000
#: Bytes of a store's root, which has no list of episodes; real ones have up to 100 kB.
ROOT_BYTES = 4_000_000
#: Objects and lists in a document. An empty list takes three bytes of a file and sixty of memory. Attributes with a
#: thousand prompts of two hundred pieces have 200,000.
DOCUMENT_NESTS = 1_000_000
#: Levels of lists and objects in one another; ours have 6, and Python's recursion ends at 1,000.
NESTING = 64
#: Bytes of a results file. 500 episodes of 60 replans with 19 layers take 170 MB.
RESULTS_BYTES = 1_000_000_000
#: Objects and lists in a results file: one a replan and layer.
RESULTS_NESTS = 10_000_000
#: Bytes of a file that a person writes: a grouping, a table of synonyms. A grouping of 100,000 words has 1.5 MB.
WRITTEN_FILE_BYTES = 4_000_000
#: Whole numbers in documents are below this: what 64 bits hold. Python itself refuses to read more than 4,300 digits.
WHOLE_NUMBER = 2**63

# Locks on the episodes of a store, and logs of the workers that fill it.

#: Bytes of a lock: names of a host and of a job, and some numbers, in 300 bytes.
LOCK_BYTES = 10_000
#: Locks or logs of a store: one for each process that fills it. Clusters allow arrays of some thousand tasks.
JOB_FILES = 100_000
#: Bytes of a store's logs together; a log has 80 for an episode that was written and up to 1,200 for one that was
#: dropped. They are in memory at once, which takes ten times as much.
LOGS_BYTES = 100_000_000
#: Episodes that the logs of a store plan. Each that is missing is counted by its number.
PLANNED_EPISODES = 1_000_000

# Texts.

#: Characters of a name that is part of a path; file systems take 255 bytes.
NAME_CHARACTERS = 255
#: Characters of a text of one line: a checkpoint's path, a version. Linux has paths of up to 4,096.
LINE_CHARACTERS = 4096
#: Characters of an instruction or a prompt. A language model reads at most some ten thousand.
TEXT_CHARACTERS = 100_000
#: Characters of an error's sentence; what is longer repeats what was given.
SENTENCE_CHARACTERS = 4000
#: Characters of one given value or name in a sentence.
SHOWN_CHARACTERS = 300
#: Names among which the nearest to a misspelt one is looked for; each takes ten microseconds.
COMPARED_NAMES = 5000

# What a run and its episodes may have.

#: Keys of a site. A policy with a context of a million tokens would need a petabyte for its rows.
KEYS = 2**20
#: Spans of a site, and sites of a run; ours have up to 12 and 2.
SPANS = 1000
SITES = 64
#: Layers, heads or denoise steps. The largest models have some hundred layers and heads, diffusion 1,000 steps.
AXIS = 10_000
#: Action queries of a replan.
QUERIES = 100_000
#: Places of a replan: layers x denoise steps x heads x queries. Cosmos with all queries has 450,000.
PLACES = 10_000_000
#: Conditions whose effects an episode has, and their entries: one for each replan and condition.
CONDITIONS = 10_000
EFFECT_ENTRIES = 1_000_000
#: Bodies of a scene whose poses are stored, and tasks that share a scene. LIBERO's scenes have up to 20 and 10.
BODIES = 10_000
GOALS = 10_000
#: Replans of an episode: fourteen hours at 20 calls a second.
REPLANS = 1_000_000
#: Rows or columns of a picture, and its pixels: a little more than 4K.
PICTURE_SIDE = 8192
PICTURE_PIXELS = 10_000_000
#: Bytes of a picture as a PNG or JPEG: such a one of four numbers of two bytes a pixel, not compressed.
PICTURE_BYTES = 80_000_000

# Servers.

#: Seconds without a connection, or without a further byte, after which a server counts as silent. aiohttp's own limit
#: is five minutes for a whole answer: too long for a server that hangs, and too short for a large file.
ANSWER_WITHIN_S = 60.0
#: Bytes a second that an answer must have on average, beyond its first `ANSWER_WITHIN_S`. A line of 1 Mbit/s, shared by
#: eight requests, gives each 15,000. A server that sends a byte a second is never silent.
SLOWEST_BYTES_A_SECOND = 10_000
#: Names in a folder that is listed elsewhere, or files below it.
LISTED_NAMES = 1_000_000

# Bytes of arrays.

#: Decoded bytes that any chunk or reading may claim, however little is stored.
CLAIMED_BYTES = 64_000_000
#: Decoded bytes for each stored one, beyond `CLAIMED_BYTES`. Rows compress to a half or less, to a tenth where half of
#: the keys are masked.
EXPANSION = 100
#: Bytes of a file that is read whole: an array of one chunk. Arrays that are longer are shards, read chunk by chunk.
WHOLE_FILE_BYTES = 256_000_000
#: Files of an episode; see "Few files" in docs/store.md: 52.
EPISODE_FILES = 10_000
#: Bytes of an array; numpy counts them in 64 bits.
ARRAY_BYTES = 2**50
#: Axes of an array.
ARRAY_AXES = 8

# Data sets of robots.

#: Episodes; the largest published data sets have 440,000.
DATA_SET_EPISODES = 1_000_000
#: Bytes of a file of lines (episodes, tasks). 440,000 episodes have 45 MB of lines.
DATA_SET_TEXT_BYTES = 128_000_000
#: Key frames before the last one at which decoding begins again, where a picture does not come out: in an open group,
#: pictures need the one before.
VIDEO_EARLIER_KEYS = 8

# Groupings.

#: Groups of a grouping. What is printed and drawn of hundreds cannot be read; two of them are compared with each other.
GROUPS = 1000
#: Parentheses in one another in a selector.
PARENTHESES = 100
