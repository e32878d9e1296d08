"""YAML of plain values, as this package and RL Zoo write it."""

import re
from typing import Any

import yaml


class PlainLoader(yaml.SafeLoader):
    """YAML 1.1 without objects or keys twice, and with ``1e-3`` and ``1e6`` as numbers (PyYAML wants a dot in them)."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.composer.ComposerError(None, None, f"'{key.value}' is there twice", key.start_mark)
                seen.add((key.tag, key.value))
        return node


PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d[\d_]*(\.[\d_]*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def _ordered_mapping(loader: yaml.SafeLoader, node: yaml.Node) -> dict[str, Any]:
    """RL Zoo tags the mapping of a ``config.yml`` as an ``OrderedDict``: its pairs are read as a plain mapping."""
    try:
        (pairs,) = loader.construct_sequence(node, deep=True)  # type: ignore[arg-type]  # else ConstructorError
        return dict(pairs)
    except (TypeError, ValueError):
        raise yaml.constructor.ConstructorError(None, None, "not an ordered mapping", node.start_mark) from None


PlainLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered_mapping)
