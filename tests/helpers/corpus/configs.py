"""Invalid configurations: ``--config`` and ``--set``."""

from __future__ import annotations

from helpers.corpus.cameras import bomb
from helpers.corpus.case import Case, Damage, Fails, Succeeds, add_options, all_of, write


def config(content: str | bytes, *more: str) -> Damage:
    """Write a configuration file and use it, with more options."""
    return all_of(write("own.yaml", content), add_options("--config", "{seq}/own.yaml", *more))


def setting(value: str) -> Damage:
    """Set a value by ``--set``."""
    return add_options("--set", value)


INVALID_YAML = "{seq}/own.yaml: is not valid YAML (...); repair it"

CASES = [
    Case("empty file", config(""), Succeeds()),
    Case("comments only", config("# nothing\n"), Succeeds()),
    Case("byte order mark", config("\ufeffseed: 1\n"), Succeeds()),
    Case("Windows line endings", config("seed: 1\r\nthreads: 1\r\n"), Succeeds()),
    Case(
        "no-break spaces",
        config("seed:\u00a01\nobjects:\n\u00a0\u00a0voting: {vote_threshold:\u202f2}\u200b\n"),
        Succeeds(),
    ),
    Case("no-break space in --set", setting("seed=\u00a01"), Succeeds()),
    Case(
        "missing file",
        add_options("--config", "{root}/none.yaml"),
        Fails(
            "{root}/none.yaml: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"
        ),
    ),
    Case(
        "folder instead of a file",
        add_options("--config", "{seq}"),
        Fails("{seq}: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "image instead of a file",
        add_options("--config", "{seq}/rgb/1305031102.000000.png"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is not a UTF-8 text file; convert it to UTF-8 (a"
            " configuration is a YAML file)"
        ),
    ),
    Case(
        "name with 5000 letters",
        add_options("--config", 5000 * "x"),
        Fails("...: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "home folder of an unknown user",
        add_options("--config", "~nobody-of-this-name/own.yaml"),
        Fails(
            "~nobody-of-this-name/own.yaml: is neither the name of a configuration (full, ...) nor a YAML file;"
            " check name or path"
        ),
    ),
    Case(
        "endless device file",
        add_options("--config", "/dev/zero"),
        Fails("/dev/zero: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "UTF-16",
        config("seed: 1\n".encode("utf-16")),
        Fails("{seq}/own.yaml: is not a UTF-8 text file; convert it to UTF-8 (a configuration is a YAML file)"),
    ),
    Case("invalid YAML", config("objects: {voting\n"), Fails(INVALID_YAML)),
    Case("tabs", config("objects:\n\tvoting: 1\n"), Fails(INVALID_YAML)),
    Case(
        "YAML tag that runs a command",
        config("!!python/object/apply:os.system ['touch /tmp/owned']\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "YAML tag that creates an object",
        config("seed: !!python/object:v3d_torch.config.schema.Config {}\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "unknown YAML tag",
        config("seed: !number 3\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "nested YAML aliases",
        config(bomb() + "seed: *a8\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "recursive YAML anchor",
        config("objects: &o\n  voting: *o\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "YAML nested 3000 times",
        config(3000 * "[" + 3000 * "]"),
        Fails(INVALID_YAML),
    ),
    Case(
        "number with 5000 digits",
        config("seed: " + 5000 * "1"),
        Fails(INVALID_YAML),
    ),
    Case("invalid date", config("seed: 2024-99-99\n"), Fails(INVALID_YAML)),
    Case(
        "invalid Boolean",
        config("seed: !!bool perhaps\n"),
        Fails(INVALID_YAML),
    ),
    Case("two documents", config("seed: 1\n---\nseed: 2\n"), Fails(INVALID_YAML)),
    Case(
        "list", config("- seed\n"), Fails("{seq}/own.yaml: contains a list; a configuration is a mapping of sections")
    ),
    Case("word", config("seed\n"), Fails("{seq}/own.yaml: contains a str; a configuration is a mapping of sections")),
    Case(
        "unknown key",
        config("objects: {voting: {vote_treshold: 3}}\n"),
        Fails("{seq}/own.yaml: unknown key objects.voting.vote_treshold; did you mean objects.voting.vote_threshold?"),
    ),
    Case(
        "key that is a number",
        config("1: 2\n"),
        Fails("{seq}/own.yaml: unknown key 1; choose from seed, threads, ..., stages"),
    ),
    Case("key that is a list", config("? [a, b]\n: 2\n"), Fails(INVALID_YAML)),
    Case(
        "value instead of a section",
        config("objects: 3\n"),
        Fails("{seq}/own.yaml: objects: input should be a valid dictionary of keys, got 3"),
    ),
    Case(
        "empty section",
        config("objects:\n"),
        Fails("{seq}/own.yaml: objects: input should be a valid dictionary of keys, got None"),
    ),
    Case(
        "section instead of a value",
        config("seed: {value: 3}\n"),
        Fails("{seq}/own.yaml: seed: input should be a valid integer, got {'value': 3}"),
    ),
    Case(
        "word instead of a number",
        config("features: {count: many}\n"),
        Fails(
            "{seq}/own.yaml: features.count: input should be a valid integer, unable to parse string as an"
            " integer, got 'many'"
        ),
    ),
    Case(
        "negative value",
        config("features: {count: -1}\n"),
        Fails("{seq}/own.yaml: features.count: input should be greater than 0, got -1"),
    ),
    Case(
        "value NaN",
        config("features: {max_depth: .nan}\n"),
        Fails("{seq}/own.yaml: features.max_depth: input should be greater than 0, got nan"),
    ),
    Case(
        "unknown key in --set beside a file",
        config("seed: 1\n", "--set", "sed=2"),
        Fails("--set: unknown key sed; did you mean seed?"),
    ),
    Case(
        "invalid value in --set beside a file",
        config("seed: 1\n", "--set", "features.count=few"),
        Fails(
            "--set: features.count: input should be a valid integer, unable to parse string as an integer, got 'few'"
        ),
    ),
    Case(
        "invalid file beside a valid --set",
        config("features: {count: few}\n", "--set", "features.count=500"),
        Fails(
            "{seq}/own.yaml: features.count: input should be a valid integer, unable to parse string as an"
            " integer, got 'few'"
        ),
    ),
    Case(
        "--set with an unknown key",
        setting("objects.voting.vote_treshold=3"),
        Fails("--set: unknown key objects.voting.vote_treshold; did you mean objects.voting.vote_threshold?"),
    ),
    Case(
        "--set without a value",
        setting("features.count"),
        Fails("--set 'features.count': write section.key=value, such as objects.voting.vote_threshold=2"),
    ),
    Case(
        "--set with an empty value",
        setting("features.count="),
        Fails("--set: features.count: input should be a valid integer, got None"),
    ),
    Case(
        "--set without a key",
        setting("=3"),
        Fails("--set '=3': write section.key=value, such as objects.voting.vote_threshold=2"),
    ),
    Case(
        "--set with a key with two dots",
        setting("features..count=3"),
        Fails("--set: unknown key features.; choose from count, levels, scale, cell, max_depth"),
    ),
    Case(
        "--set with a key below a value",
        setting("seed.more=3"),
        Fails("--set: seed: input should be a valid integer, got {'more': 3}"),
    ),
    Case(
        "--set with a value for a section",
        setting("features=3"),
        Fails("--set: features: input should be a valid dictionary of keys, got 3"),
    ),
    Case(
        "--set with invalid YAML",
        setting("seed=[1"),
        Fails("--set 'seed=[1': the value is not valid YAML (line 1: expected ',' or ']', but got '<stream end>')"),
    ),
    Case(
        "--set with a YAML tag",
        setting("seed=!!python/name:os.system"),
        Fails(
            "--set 'seed=!!python/name:os.system': the value is not valid YAML (line 1: could not determine"
            " a constructor for the tag 'tag:yaml.org,2002:python/name:os.system')"
        ),
    ),
    Case(
        "--set with a word instead of a number",
        setting("seed=three"),
        Fails("--set: seed: input should be a valid integer, unable to parse string as an integer, got 'three'"),
    ),
    Case(
        "--set with a negative number",
        setting("features.count=-3"),
        Fails("--set: features.count: input should be greater than 0, got -3"),
    ),
    Case(
        "--set with a fractional number",
        setting("features.count=3.5"),
        Fails("--set: features.count: input should be a valid integer, got a number with a fractional part, got 3.5"),
    ),
    Case("--set with infinity", setting("depth.sigma=.inf"), Succeeds()),
    Case(
        "--set with an even window size",
        setting("depth.kernel_size=4"),
        Fails("--set: depth.kernel_size: input should be 1, 3, 5, 7, 9, 11, 13 or 15, got 4"),
    ),
    Case(
        "--set with a window larger than the image",
        setting("depth.kernel_size=1001"),
        Fails("--set: depth.kernel_size: input should be 1, 3, 5, 7, 9, 11, 13 or 15, got 1001"),
    ),
    Case(
        "--set with a huge seed",
        setting("seed=100000000000000000000"),
        Fails("--set: seed: input should be less than 9223372036854775808, got 100000000000000000000"),
    ),
    Case(
        "--set with a million threads",
        setting("threads=1000000"),
        Fails("--set: threads: input should be less than or equal to 256, got 1000000"),
    ),
    Case(
        "--set with an unknown choice",
        setting("segmentation.source=sam"),
        Fails("--set: segmentation.source: input should be 'yolo', 'masks' or 'none', got 'sam'"),
    ),
    Case(
        "--set with a hundred levels",
        setting("features.levels=100"),
        Fails("--set: features.levels: input should be less than or equal to 20, got 100"),
    ),
    Case("--set with no time spans", setting("objects.voting.time_spans=[]"), Succeeds()),
    Case(
        "--set with negative time spans",
        setting("objects.free_space.time_spans=[-1]"),
        Fails("--set: objects.free_space.time_spans.0: input should be greater than or equal to 0, got -1"),
    ),
    Case(
        "--set with a tiny voxel size",
        setting("dense_map.voxel_size=0.0001"),
        Fails("--set: dense_map.voxel_size: input should be greater than or equal to 0.001, got 0.0001"),
    ),
    Case(
        "--set with a tiny number",
        setting("depth.sigma=1e-30"),
        Fails("--set: depth.sigma: input should be between 1e-09 and 1e+09, got 1e-30"),
    ),
    Case(
        "negative --seed",
        add_options("--seed", "-1"),
        Fails("--seed -1: seed: input should be greater than or equal to 0, got -1"),
    ),
    Case(
        "unknown --segmenter",
        add_options("--segmenter", "sam"),
        Fails("--segmenter sam: segmentation.source: input should be 'yolo', 'masks' or 'none', got 'sam'"),
    ),
    Case(
        "unknown --model",
        add_options("--model", "yolov8x-seg"),
        Fails(
            "--model yolov8x-seg: segmentation.model: input should be 'yolov8n-seg', 'yolo11n-seg' or 'yolo26n-seg',"
            " got 'yolov8x-seg'"
        ),
    ),
]
