"""Sizes of networks: defaults filled in, and refused where they cannot be."""

from collections.abc import Collection, Mapping

from rtc_cli.errors import UsageError, did_you_mean


def complete_sizes(
    network: str,
    options: Mapping[str, int],
    defaults: Mapping[str, int],
    *,
    zero_allowed: Collection[str] = (),
) -> dict[str, int]:
    """Complete the sizes of a network; UsageError names the option and what is allowed."""
    for name, value in options.items():
        if name not in defaults:
            raise UsageError(
                f'unknown {network} option "{name}".{did_you_mean(name, defaults)}',
                "use one of the allowed options",
            )
        least = 0 if name in zero_allowed else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise UsageError(f"{network} option {name} = {value!r}", f"give an integer >= {least}")
    return dict(defaults) | dict(options)


def require_even(network: str, sizes: Mapping[str, int], name: str) -> None:
    """Refuse an odd width of a time embedding."""
    if sizes[name] % 2:
        raise UsageError(
            f"{network} option {name} = {sizes[name]} is odd: half of the time features are"
            " sines, half cosines",
            "give an even number",
        )
