"""Named tuples in compiled code: they stay where they lie, their fields are read there, and calls pass their address.

Numba loads a tuple of arrays as a whole wherever one of its fields is read, and passes each number in it as an argument
of its own. The record of a cluster has 400 of them, and most of the time in which kernels were compiled went into
copies that the optimiser had to take apart again. Here a field is read at its address. A tuple that a function was
given is not copied at all: nobody changes it while the function runs, since tuples are immutable and a variable of the
caller changes only between its calls. Arrays in a tuple are still changed in place, as those of any argument.
"""

from collections import Counter
from functools import cached_property
from typing import Any

from llvmlite.ir import Argument, BaseStructType, PointerType
from llvmlite.ir.instructions import GEPInstr, LoadInstr, StoreInstr
from numba.core import cgutils, ir, types
from numba.core.datamodel import register_default
from numba.core.datamodel.models import TupleModel
from numba.core.lowering import Lower


@register_default(types.NamedTuple)
class _TupleModel(TupleModel):
    """A named tuple as numba represents it, except that one of this package with arrays is passed by its address.

    Numba has one model for the named tuples of the whole process: those of other programs must keep its own.
    """

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind)
        # A few numbers are passed faster in registers.
        ours = kind.instance_class.__module__.split(".")[0] == __package__
        self._by_address = ours and any(isinstance(part, types.Array | types.NamedTuple) for part in kind)

    def get_argument_type(self) -> Any:
        """The type, or tuple of types, of the tuple as an argument."""
        if self._by_address:
            return self.get_value_type().as_pointer()
        return super().get_argument_type()

    def as_argument(self, builder: Any, value: Any) -> Any:
        """The argument for a call with ``value``: where it was loaded from, else the address of a copy."""
        if not self._by_address:
            return super().as_argument(builder, value)
        if isinstance(value, LoadInstr) and _is_unchanged(value, builder.block):
            return value.operands[0]
        return cgutils.alloca_once_value(builder, value)

    def from_argument(self, builder: Any, value: Any) -> Any:
        """The tuple that an argument stands for."""
        if self._by_address:
            return builder.load(value)
        return super().from_argument(builder, value)


def _variable_of(address: Any) -> Any:
    """The argument or variable that an ``address`` lies in."""
    while isinstance(address, GEPInstr):
        address = address.operands[0]
    return address


def _is_unchanged(load: LoadInstr, block: Any) -> bool:
    """Whether at the end of ``block`` the place of ``load`` still has the tuple that was loaded; False if unclear."""
    variable = _variable_of(load.operands[0])
    if isinstance(variable, Argument):
        return True
    for instruction in reversed(block.instructions):
        if instruction is load:
            return True
        # Calls store nothing in it: they return results in variables of their own.
        if isinstance(instruction, StoreInstr) and _variable_of(instruction.operands[1]) is variable:
            return False
    return False


class TupleLower(Lower):
    """Numba's translation of a function for LLVM, with fields of named tuples read at their addresses.

    ``_addresses`` are those of tuples that variables stand for. The variables ``_given`` have no memory of their own:
    they are arguments, or tuples in these, which own the arrays as long as the function runs.
    """

    def init(self) -> None:
        """Begin without addresses."""
        super().init()
        self._addresses: dict[str, Any] = {}
        self._given: set[str] = set()

    @cached_property
    def _assignments(self) -> Counter[str]:
        """How many assignments each variable has."""
        return Counter(
            assignment.target.name for block in self.blocks.values() for assignment in block.find_insts(ir.Assign)
        )

    def setup_function(self, description: Any) -> None:
        """Declare the function; no array that it writes to overlaps a tuple that it is given."""
        super().setup_function(description)
        for argument in self.call_conv.get_arguments(self.function):
            if isinstance(argument.type, PointerType) and isinstance(argument.type.pointee, BaseStructType):
                argument.add_attribute("noalias")

    def lower_assign(self, kind: Any, assignment: Any) -> Any:
        """The value of an ``assignment`` of a type ``kind``; of a tuple that is not copied there is none."""
        name = assignment.target.name
        source = assignment.value
        address = self._address_of(source)
        if address is None:
            return super().lower_assign(kind, assignment)

        if isinstance(kind, types.NamedTuple) and self._assignments[name] == 1:
            if self._is_given(source):
                self._addresses[name] = address
                self._given.add(name)
                return None
            # A temporary variable is used in the expression that made it, before the tuple can be replaced; where
            # references are counted, the tuple may have been cleared.
            if name.startswith("$") and not self.context.enable_nrt:
                self._addresses[name] = address

        if not isinstance(source, ir.Expr):
            return super().lower_assign(kind, assignment)
        value = self.builder.load(address)
        self.incref(kind, value)
        return value

    def _is_given(self, source: Any) -> bool:
        """Whether the ``source`` of an assignment is an argument, or a tuple in one."""
        if isinstance(source, ir.Expr):
            source = source.value
        return isinstance(source, ir.Arg) or source.name in self._given

    def _address_of(self, source: Any) -> Any:
        """The address of the ``source`` of an assignment, None if it has none or is no tuple and no field of one."""
        if isinstance(source, ir.Arg):
            value = self.fnargs[source.index]
            is_tuple = isinstance(self.typeof(f"arg.{source.name}"), types.NamedTuple)
            return value.operands[0] if is_tuple and isinstance(value, LoadInstr) else None
        if isinstance(source, ir.Var):
            return self._addresses.get(source.name)
        if isinstance(source, ir.Expr) and source.op == "getattr":
            return self._field_address(source.value.name, source.attr)
        return None

    def _field_address(self, name: str, field: str) -> Any:
        """The address of a ``field`` of the variable ``name``, None if that is no named tuple or has no address."""
        if not isinstance(self.typeof(name), types.BaseNamedTuple):
            return None
        number = self.typeof(name).fields.index(field)
        if name in self._addresses:
            return cgutils.gep_inbounds(self.builder, self._addresses[name], 0, number)
        # A variable of one block is a value without memory.
        if name in self._singly_assigned_vars:
            return None
        return cgutils.gep_inbounds(self.builder, self.getvar(name), 0, number)

    def loadvar(self, name: str) -> Any:
        """The value of the variable ``name``."""
        if name in self._given:
            return self.builder.load(self._addresses[name])
        return super().loadvar(name)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Give the variable ``name`` its ``value``, if it has memory of its own."""
        if name not in self._given:
            super().storevar(value, name, argidx)

    def delvar(self, name: str) -> None:
        """End the use of the variable ``name``; without references to count nothing is to be done."""
        if name not in self._given and self.context.enable_nrt:
            super().delvar(name)
