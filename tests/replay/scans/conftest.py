from tests.encodings.conftest import content

__all__ = ["content"]
