"""Configurations: ``--config`` and ``--set``."""

from __future__ import annotations

from helpers.corpus.cameras import bomb
from helpers.corpus.case import Case, Damage, Fails, Succeeds, add_options, all_of, write


def config(content: str | bytes, *more: str) -> Damage:
    return all_of(write("own.yaml", content), add_options("--config", "{seq}/own.yaml", *more))


def setting(value: str) -> Damage:
    return add_options("--set", value)


CASES = [
    Case("empty file", config(""), Succeeds()),
    Case("comments only", config("# nothing\n"), Succeeds()),
    Case("byte order mark", config("\ufeffseed: 1\n"), Succeeds()),
    Case("Windows line ends", config("seed: 1\r\nthreads: 1\r\n"), Succeeds()),
    Case(
        "not there",
        add_options("--config", "{root}/none.yaml"),
        Fails(
            "{root}/none.yaml: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"
        ),
    ),
    Case(
        "a folder",
        add_options("--config", "{seq}"),
        Fails("{seq}: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "an image",
        add_options("--config", "{seq}/rgb/1305031102.000000.png"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is not a UTF-8 text file; convert it to UTF-8 (a"
            " configuration is a YAML file)"
        ),
    ),
    Case(
        "a name of 5000 letters",
        add_options("--config", 5000 * "x"),
        Fails("...: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "in the home of nobody",
        add_options("--config", "~nobody-of-this-name/own.yaml"),
        Fails(
            "~nobody-of-this-name/own.yaml: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"
        ),
    ),
    Case(
        "a device without end",
        add_options("--config", "/dev/zero"),
        Fails("/dev/zero: is neither the name of a configuration (full, ...) nor a YAML file; check name or path"),
    ),
    Case(
        "UTF-16",
        config("seed: 1\n".encode("utf-16")),
        Fails("{seq}/own.yaml: is not a UTF-8 text file; convert it to UTF-8 (a configuration is a YAML file)"),
    ),
    Case("broken YAML", config("objects: {voting\n"), Fails("{seq}/own.yaml: is not valid YAML (...); repair it")),
    Case("tabs", config("objects:\n\tvoting: 1\n"), Fails("{seq}/own.yaml: is not valid YAML (...); repair it")),
    Case(
        "a tag that runs a command",
        config("!!python/object/apply:os.system ['touch /tmp/owned']\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "a tag for an object",
        config("seed: !!python/object:v3d_torch.config.schema.Config {}\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "a tag that nobody knows",
        config("seed: !number 3\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "anchors that multiply",
        config(bomb() + "seed: *a8\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "an anchor within itself",
        config("objects: &o\n  voting: *o\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "nested three thousand times",
        config(3000 * "[" + 3000 * "]"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "a number of 5000 digits",
        config("seed: " + 5000 * "1"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "a date that is none", config("seed: 2024-99-99\n"), Fails("{seq}/own.yaml: is not valid YAML (...); repair it")
    ),
    Case(
        "a Boolean that is none",
        config("seed: !!bool perhaps\n"),
        Fails("{seq}/own.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "two documents", config("seed: 1\n---\nseed: 2\n"), Fails("{seq}/own.yaml: is not valid YAML (...); repair it")
    ),
    Case(
        "a list", config("- seed\n"), Fails("{seq}/own.yaml: contains a list; a configuration is a mapping of sections")
    ),
    Case("a word", config("seed\n"), Fails("{seq}/own.yaml: contains a str; a configuration is a mapping of sections")),
    Case(
        "an unknown key",
        config("objects: {voting: {vote_treshold: 3}}\n"),
        Fails("{seq}/own.yaml: unknown key objects.voting.vote_treshold; did you mean objects.voting.vote_threshold?"),
    ),
    Case("a key that is a number", config("1: 2\n"), Fails("{seq}/own.yaml: unknown key 1; did you mean tracking?")),
    Case(
        "a key that is a list", config("? [a, b]\n: 2\n"), Fails("{seq}/own.yaml: is not valid YAML (...); repair it")
    ),
    Case(
        "a value for a section",
        config("objects: 3\n"),
        Fails("{seq}/own.yaml: objects: input should be a valid dictionary of keys, got 3"),
    ),
    Case(
        "a section with nothing in it",
        config("objects:\n"),
        Fails("{seq}/own.yaml: objects: input should be a valid dictionary of keys, got None"),
    ),
    Case(
        "a section for a value",
        config("seed: {value: 3}\n"),
        Fails("{seq}/own.yaml: seed: input should be a valid integer, got {'value': 3}"),
    ),
    Case(
        "a word for a number",
        config("features: {count: many}\n"),
        Fails(
            "{seq}/own.yaml: features.count: input should be a valid integer, unable to parse string as an"
            " integer, got 'many'"
        ),
    ),
    Case(
        "a negative value",
        config("features: {count: -1}\n"),
        Fails("{seq}/own.yaml: features.count: input should be greater than 0, got -1"),
    ),
    Case(
        "a value that is not a number",
        config("features: {max_depth: .nan}\n"),
        Fails("{seq}/own.yaml: features.max_depth: input should be greater than 0, got nan"),
    ),
    Case(
        "--set over a file: an unknown key",
        config("seed: 1\n", "--set", "sed=2"),
        Fails("--set: unknown key sed; did you mean seed?"),
    ),
    Case(
        "--set over a file: a wrong value",
        config("seed: 1\n", "--set", "features.count=few"),
        Fails(
            "--set: features.count: input should be a valid integer, unable to parse string as an integer, got 'few'"
        ),
    ),
    Case(
        "a wrong file under a right --set",
        config("features: {count: few}\n", "--set", "features.count=500"),
        Fails(
            "{seq}/own.yaml: features.count: input should be a valid integer, unable to parse string as an"
            " integer, got 'few'"
        ),
    ),
    Case(
        "--set of an unknown key",
        setting("objects.voting.vote_treshold=3"),
        Fails("--set: unknown key objects.voting.vote_treshold; did you mean objects.voting.vote_threshold?"),
    ),
    Case(
        "--set without a value",
        setting("features.count"),
        Fails("--set 'features.count': write section.key=value, such as objects.voting.vote_threshold=2"),
    ),
    Case(
        "--set of an empty value",
        setting("features.count="),
        Fails("--set: features.count: input should be a valid integer, got None"),
    ),
    Case(
        "--set without a key",
        setting("=3"),
        Fails("--set '=3': write section.key=value, such as objects.voting.vote_threshold=2"),
    ),
    Case(
        "--set of a key with two dots",
        setting("features..count=3"),
        Fails("--set: unknown key features.; did you mean features.scale?"),
    ),
    Case(
        "--set of a key below a value",
        setting("seed.more=3"),
        Fails("--set: seed: input should be a valid integer, got {'more': 3}"),
    ),
    Case(
        "--set of a section",
        setting("features=3"),
        Fails("--set: features: input should be a valid dictionary of keys, got 3"),
    ),
    Case(
        "--set of broken YAML",
        setting("seed=[1"),
        Fails("--set 'seed=[1': the value is not valid YAML (line 1: expected ',' or ']', but got '<stream end>')"),
    ),
    Case(
        "--set of a tag",
        setting("seed=!!python/name:os.system"),
        Fails(
            "--set 'seed=!!python/name:os.system': the value is not valid YAML (line 1: could not determine"
            " a constructor for the tag 'tag:yaml.org,2002:python/name:os.system')"
        ),
    ),
    Case(
        "--set of a word",
        setting("seed=three"),
        Fails("--set: seed: input should be a valid integer, unable to parse string as an integer, got 'three'"),
    ),
    Case(
        "--set of a negative number",
        setting("features.count=-3"),
        Fails("--set: features.count: input should be greater than 0, got -3"),
    ),
    Case(
        "--set of a fraction",
        setting("features.count=3.5"),
        Fails("--set: features.count: input should be a valid integer, got a number with a fractional part, got 3.5"),
    ),
    Case("--set of infinity", setting("depth.sigma=.inf"), Succeeds()),
    Case(
        "--set of an even window",
        setting("depth.kernel_size=4"),
        Fails("--set: depth.kernel_size: input should be 1, 3, 5, 7, 9, 11, 13 or 15, got 4"),
    ),
    Case(
        "--set of a window larger than the image",
        setting("depth.kernel_size=1001"),
        Fails("--set: depth.kernel_size: input should be 1, 3, 5, 7, 9, 11, 13 or 15, got 1001"),
    ),
    Case(
        "--set of a huge seed",
        setting("seed=100000000000000000000"),
        Fails("--set: seed: input should be less than 9223372036854775808, got 100000000000000000000"),
    ),
    Case(
        "--set of a million threads",
        setting("threads=1000000"),
        Fails("--set: threads: input should be less than or equal to 256, got 1000000"),
    ),
    Case(
        "--set of a choice that there is not",
        setting("segmentation.source=sam"),
        Fails("--set: segmentation.source: input should be 'yolo', 'masks' or 'none', got 'sam'"),
    ),
    Case(
        "--set of a hundred levels",
        setting("features.levels=100"),
        Fails("--set: features.levels: input should be less than or equal to 20, got 100"),
    ),
    Case("--set of no baselines", setting("objects.voting.baselines=[]"), Succeeds()),
    Case("--set of negative baselines", setting("objects.free_space.baselines=[-1]"), Succeeds()),
    Case(
        "--set of a tiny voxel",
        setting("dense_map.voxel_size=1e-30"),
        Fails("--set: dense_map.voxel_size: input should be between 1e-09 and 1e+09, got 1e-30"),
    ),
    Case(
        "--seed that is negative",
        add_options("--seed", "-1"),
        Fails("--set: seed: input should be greater than or equal to 0, got -1"),
    ),
    Case(
        "--segmenter that there is not",
        add_options("--segmenter", "sam"),
        Fails("--set: segmentation.source: input should be 'yolo', 'masks' or 'none', got 'sam'"),
    ),
    Case(
        "--model that there is not",
        add_options("--model", "yolov8x-seg"),
        Fails(
            "--set: segmentation.model: input should be 'yolov8n-seg', 'yolo11n-seg' or 'yolo26n-seg', got"
            " 'yolov8x-seg'"
        ),
    ),
]
