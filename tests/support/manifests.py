"""What Kubernetes makes of manifests, as far as the laws about them need it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import yaml

Object = dict[str, Any]


class Manifests(NamedTuple):
    """Objects by kind and name."""

    objects: Mapping[str, Mapping[str, Object]]

    def of(self, *kinds: str) -> Iterator[Object]:
        for kind in kinds:
            yield from self.objects.get(kind, {}).values()

    @property
    def pods(self) -> dict[str, Object]:
        """Name of a workload -> its template of a pod."""
        return {each["metadata"]["name"]: each["spec"]["template"] for each in self.of("Deployment", "StatefulSet")}

    def chosen(self, selector: Mapping[str, str]) -> set[str]:
        """Pods whose labels have all of these."""
        return {name for name, pod in self.pods.items() if selector.items() <= pod["metadata"]["labels"].items()}


def load_all(text: str) -> list[Any]:
    """The documents of a YAML file; by libyaml, if PyYAML has it, as that takes a tenth."""
    return list(yaml.load_all(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)))


def read_manifests(*texts: str) -> Manifests:
    """Every object of these files, none of them twice but namespaces."""
    found: dict[str, dict[str, Object]] = defaultdict(dict)
    for text in texts:
        for each in load_all(text):
            kind, name = each["kind"], each["metadata"]["name"]
            assert kind == "Namespace" or name not in found[kind], f"two of {kind} {name}"
            found[kind][name] = each
    return Manifests(found)
