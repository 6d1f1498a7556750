# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false
# pyright: reportAssignmentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
"""Contacts and constraint rows of MuJoCo Warp in an order that does not depend on which GPU thread came first.

Threads take places in the list of contacts, and in a world's constraint rows, from atomic counters. The solver's float32
sums then round differently from run to run. `mujoco_warp`'s `opt.deterministic` adds atomically in a fixed order, but version
4.0 does not sort contacts and rows yet (`_sort_contacts` and `_sort_constraints` are empty), and Warp's own deterministic mode
cannot compile the engine's kernels. This sorts both in two of the engine's callbacks: after collision, and between the making
of the rows and the solver.
"""

from typing import Any

import warp as wp

from telebip.errors import UserError

NO_CONTACT = wp.constant(wp.int64(2**63 - 1))


@wp.kernel
def _contact_keys(
    number: wp.array[int],
    world: wp.array[int],
    geoms: wp.array[wp.vec2i],
    index: wp.array[int],
    keys: wp.array[wp.int64],
    order: wp.array[int],
):
    """Number a contact by its world, its two geoms, and which contact of theirs it is; unused places come last."""
    i = wp.tid()
    order[i] = i
    keys[i] = NO_CONTACT
    if i < number[0]:
        pair = (wp.int64(geoms[i][0]) << wp.int64(20)) | (wp.int64(geoms[i][1]) << wp.int64(8))
        keys[i] = (wp.int64(world[i]) << wp.int64(32)) | pair | wp.int64(index[i])


@wp.kernel
def _take_contacts(source: wp.array2d[int], order: wp.array[int], target: wp.array2d[int]):
    i, word = wp.tid()
    target[i, word] = source[order[i], word]


@wp.kernel
def _rank_rows(
    number: wp.array[int],
    kind: wp.array2d[int],
    index: wp.array2d[int],
    order: wp.array2d[int],
    rank: wp.array2d[int],
):
    """Rank a world's rows by kind, joint or contact, and, within one contact, as they are."""
    world, row = wp.tid()
    rows = wp.min(number[world], kind.shape[1])
    place = row
    if row < rows:
        place = int(0)  # noqa: UP018, RUF046  (Warp: a variable, which the loop may change)
        for other in range(rows):
            k, i = kind[world, other] - kind[world, row], index[world, other] - index[world, row]
            if k < 0 or (k == 0 and (i < 0 or (i == 0 and other < row))):
                place += 1
    order[world, place] = row
    rank[world, row] = place


@wp.kernel
def _move_addresses(number: wp.array[int], world: wp.array[int], rank: wp.array2d[int], address: wp.array2d[int]):
    i, dim = wp.tid()
    if i < number[0] and address[i, dim] >= 0:
        address[i, dim] = rank[world[i], address[i, dim]]


@wp.kernel
def _take_rows(source: wp.array3d[int], order: wp.array2d[int], target: wp.array3d[int]):
    world, row, word = wp.tid()
    target[world, row, word] = source[world, order[world, row], word]


class CanonicalOrder:
    """Keeps the contacts of a `mujoco_warp` model's data, and their rows, in an order of their own."""

    def __init__(self, model: Any, data: Any) -> None:
        """Enter the two callbacks of `model`, for `data` alone.

        Raises:
            UserError: the model has equality constraints, sparse Jacobians or flexible bodies, whose rows are stored otherwise.
        """
        lacks = {"equality constraints": model.neq, "a sparse Jacobian": model.is_sparse, "flexible bodies": model.nflex}
        if found := [name for name, is_there in lacks.items() if is_there]:
            raise UserError(f"sim.deterministic: backend 'warp' cannot order the rows of a robot with {found[0]}")
        if model.ngeom >= 2**12:
            raise UserError(
                f"sim.deterministic: backend 'warp' can order the contacts of 4095 geoms, and the robot has {model.ngeom}"
            )
        contact, efc, device = data.contact, data.efc, data.qpos.device
        places, worlds, rows = data.naconmax, data.nworld, data.njmax
        self._keys = wp.empty(2 * places, dtype=wp.int64, device=device)  # radix sort takes twice the room
        self._order = wp.empty(2 * places, dtype=int, device=device)
        self._row_order, self._rank = (wp.empty((worlds, rows), dtype=int, device=device) for _ in range(2))
        self._contacts = [_words(value, 1) for value in vars(contact).values() if value.size]
        made = (efc.type, efc.id, efc.J, efc.pos, efc.margin, efc.D, efc.vel, efc.aref, efc.frictionloss, efc.Jqvel)
        self._rows = [_words(value, 2) for value in made]
        self._scratch = {words.ptr: wp.empty_like(words) for words in (*self._contacts, *self._rows)}
        model.callback.contactfilter, model.callback.control = self.sort_contacts, self.sort_rows

    def sort_contacts(self, model: Any, data: Any) -> None:
        """Sort what collision has found by world, geoms, and number of the contact of these."""
        contact, places = data.contact, data.naconmax
        wp.launch(
            _contact_keys,
            dim=places,
            inputs=[data.nacon, contact.worldid, contact.geom, contact.geomcollisionid],
            outputs=[self._keys, self._order],
        )
        wp.utils.radix_sort_pairs(self._keys, self._order, places)
        for words in self._contacts:
            scratch = self._scratch[words.ptr]
            wp.copy(scratch, words)
            wp.launch(_take_contacts, dim=words.shape, inputs=[scratch, self._order], outputs=[words])

    def sort_rows(self, model: Any, data: Any) -> None:
        """Sort each world's constraint rows by kind, joint or contact; called between their making and their use."""
        contact, shape = data.contact, (data.nworld, data.njmax)
        wp.launch(_rank_rows, dim=shape, inputs=[data.nefc, data.efc.type, data.efc.id], outputs=[self._row_order, self._rank])
        wp.launch(
            _move_addresses,
            dim=contact.efc_address.shape,
            inputs=[data.nacon, contact.worldid, self._rank],
            outputs=[contact.efc_address],
        )
        for words in self._rows:
            scratch = self._scratch[words.ptr]
            wp.copy(scratch, words)
            wp.launch(_take_rows, dim=(*shape, words.shape[2]), inputs=[scratch, self._row_order], outputs=[words])


def _words(array: Any, dims: int) -> Any:
    """Return an array's memory as whole numbers of 32 bits, with its first `dims` dimensions and one more."""
    return array.view(wp.int32).reshape((*array.shape[:dims], -1))
