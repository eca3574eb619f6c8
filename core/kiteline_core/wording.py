"""Words of texts for users."""


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 keyframe", "2 keyframes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
