"""Counts the contact rows that solves in torch read: work that does not depend on the machine."""

from __future__ import annotations

from torchfilm.physics.jacobian import ContactJacobian


class RowCounter:
    """Counts the bytes of contact rows that products with J and its transpose read."""

    def __init__(self) -> None:
        self.bytes, self.products = 0, 0
        self._apply, self._transpose = ContactJacobian.apply, ContactJacobian.apply_transpose

    def __enter__(self) -> RowCounter:
        def counted(method):
            def call(rows, x):
                self.products += 1
                self.bytes += rows.row_first.nbytes + rows.row_second.nbytes + rows.row_wall.nbytes
                return method(rows, x)

            return call

        ContactJacobian.apply, ContactJacobian.apply_transpose = (
            counted(self._apply),
            counted(self._transpose),
        )
        return self

    def __exit__(self, *_: object) -> None:
        ContactJacobian.apply, ContactJacobian.apply_transpose = self._apply, self._transpose
