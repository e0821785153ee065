"""Explicit vectors of 16 float32 for Numba kernels, independent of LLVM's loop vectorizer.

A value of type `VECTOR` is one LLVM vector: one AVX-512 register, or two or four narrower ones. Local variables of a
kernel then stay in registers over any loops. Arithmetic is `+`, `-`, `*`, `/`; comparisons give a `MASK` of 16 bits.
Numba's fast-math flags apply. Kernels are cached by their own file's date: after a change here, remove the cache.
"""

import functools
import math
import operator

import numba as nb
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

from foldgauss._runtime.kernels import inline

LANES = 16
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


class _Vector(types.Type):
    """16 float32."""


class _Mask(types.Type):
    """16 bits."""


VECTOR = _Vector("floats16")
MASK = _Mask("bits16")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, _FLOATS)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, ir.VectorType(ir.IntType(1), LANES))


def _place(context, builder, array_type, array, index, vector=_FLOATS):
    """Pointer to 16 numbers of a contiguous array of four-byte ones, from `index` on."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _broadcast(builder, scalar, vector=_FLOATS):
    empty = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, empty, ir.Constant(_INTS, [0] * LANES))


def _generates(typed, prefer_literal=False):
    """Decorate a generator of LLVM code as an intrinsic; `typed` gives its signature for the types of its arguments."""

    def decorate(generate):
        @functools.wraps(typed)
        def define(context, *arguments):
            return typed(context, *arguments), generate

        return intrinsic(prefer_literal=prefer_literal)(define)

    return decorate


@_generates(lambda context, scalar: VECTOR(types.float32))
def broadcast(context, builder, signature, args):
    """A vector of one float32, 16 times."""
    return _broadcast(builder, args[0])


@_generates(lambda context: VECTOR())
def cell_columns(context, builder, signature, args):
    """The vector (0, 1, 2, 3, 0, 1, ...): the pixels' columns in a cell of 4 x 4, row by row."""
    return ir.Constant(_FLOATS, [float(k % 4) for k in range(LANES)])


@_generates(lambda context: VECTOR())
def cell_rows(context, builder, signature, args):
    """The vector (0, 0, 0, 0, 1, 1, ...): likewise their rows."""
    return ir.Constant(_FLOATS, [float(k // 4) for k in range(LANES)])


@_generates(lambda context, array, index: VECTOR(array, types.uint64))
def load(context, builder, signature, args):
    """16 floats of a contiguous float32 array, from an index on; no bounds are checked."""
    return builder.load(_place(context, builder, signature.args[0], *args), align=4)


@_generates(lambda context, array, index, vector: types.none(array, types.uint64, VECTOR))
def store(context, builder, signature, args):
    """Write 16 floats into a contiguous float32 array, from an index on; no bounds are checked."""
    builder.store(args[2], _place(context, builder, signature.args[0], *args[:2]), align=4)
    return context.get_dummy_value()


def _arithmetic(name):
    @_generates(lambda context, a, b: VECTOR(VECTOR, VECTOR))
    def operation(context, builder, signature, args):
        return getattr(builder, name)(*args)

    return operation


def _comparison(sign):
    @_generates(lambda context, a, b: MASK(VECTOR, VECTOR))
    def operation(context, builder, signature, args):
        """False where a number is NaN."""
        return builder.fcmp_ordered(sign, *args)

    return operation


@_generates(lambda context, a, b: MASK(MASK, MASK))
def _both(context, builder, signature, args):
    return builder.and_(*args)


def _on_operator(symbol, kind, operation):
    @overload(symbol, inline="always")
    def implement(a, b):
        if isinstance(a, kind) and isinstance(b, kind):
            return lambda a, b: operation(a, b)
        return None


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _on_operator(_symbol, _Vector, _arithmetic(_name))
for _symbol, _sign in ((operator.ge, ">="), (operator.gt, ">"), (operator.lt, "<")):
    _on_operator(_symbol, _Vector, _comparison(_sign))
_on_operator(operator.and_, _Mask, _both)


@_generates(lambda context, mask, a, b: VECTOR(MASK, VECTOR, VECTOR))
def select(context, builder, signature, args):
    """The first vector where the mask is set, else the second."""
    return builder.select(*args)


@_generates(lambda context, mask: types.boolean(MASK))
def any_set(context, builder, signature, args):
    """Whether any bit is set."""
    bits = builder.bitcast(args[0], ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))


@_generates(lambda context, first, last, index, number: types.uint64(first, last, types.uint64, types.int32))
def range_mask(context, builder, signature, args):
    """The 16 lowest bits: in which of 16 places from an index on first <= number < last; int32 arrays and number."""
    ends = (_place(context, builder, signature.args[k], args[k], args[2], _INTS) for k in (0, 1))
    low, high = (builder.load(end, align=4) for end in ends)
    wanted = _broadcast(builder, args[3], _INTS)
    bits = builder.and_(builder.icmp_signed("<=", low, wanted), builder.icmp_signed("<", wanted, high))
    return builder.zext(builder.bitcast(bits, ir.IntType(LANES)), ir.IntType(64))


@_generates(lambda context, bits: types.uint64(types.uint64))
def lowest_bit(context, builder, signature, args):
    """The place of the lowest bit that is set; there must be one."""
    return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))


@_generates(lambda context, x: types.UniTuple(VECTOR, 2)(VECTOR))
def split_exponent(context, builder, signature, args):
    """(whole, part): x rounded to whole, moved to the place of a float's exponent, and what is left, in [-0.5, 0.5]."""
    rint = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_FLOATS, [_FLOATS]), "llvm.rint.v16f32")
    near = builder.call(rint, args)
    whole = builder.shl(builder.fptosi(near, _INTS), ir.Constant(_INTS, [23] * LANES))
    part = builder.fsub(args[0], near)
    return context.make_tuple(builder, signature.return_type, (builder.bitcast(whole, _FLOATS), part))


@_generates(lambda context, value, whole: VECTOR(VECTOR, VECTOR))
def scale_by_power(context, builder, signature, args):
    """A value times 2 to the power `whole` from `split_exponent`, within float32's normal range."""
    return builder.bitcast(builder.add(*(builder.bitcast(arg, _INTS) for arg in args)), _FLOATS)


@_generates(lambda context, x: VECTOR(VECTOR))
def sqrt(context, builder, signature, args):
    """The square root."""
    kind = ir.FunctionType(_FLOATS, [_FLOATS])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v16f32"), args)


_f = nb.float32


@inline
def exp2(x):
    """2^x within 2e-7: a polynomial of the part in [-0.5, 0.5], the whole part into the exponent.

    For x in [-126, 127]; other results are meaningless.
    """
    whole, part = split_exponent(x)
    y = broadcast(_f(1.3264727e-3))
    y = y * part + broadcast(_f(9.671513e-3))
    y = y * part + broadcast(_f(5.5507336e-2))
    y = y * part + broadcast(_f(0.24022242))
    y = y * part + broadcast(_f(0.693147))
    y = y * part + broadcast(_f(1.0))
    return scale_by_power(y, whole)


@inline
def exp(x):
    """e^x: within 4e-7 for |x| < 5, 1e-5 for |x| < 87.3; beyond it stays at the ends of these."""
    y, most = x * broadcast(_f(math.log2(math.e))), broadcast(_f(126.0))
    y = select(y < most, y, most)
    y = select(y > broadcast(_f(-126.0)), y, broadcast(_f(-126.0)))
    return select(x >= x, exp2(y), x)  # NaN propagates


@inline
def sigmoid(x):
    """1 / (1 + e^-x)."""
    one = broadcast(_f(1.0))
    return one / (one + exp(broadcast(_f(0.0)) - x))


@inline
def cos_and_sin(turns):
    """Cosine and sine of 2 pi x within 5e-7: the series of pi x, to its 12th power, then the angle doubled."""
    _, part = split_exponent(turns)
    square = part * part
    y = broadcast(_f(-0.00737043094571435))
    y = y * square + broadcast(_f(0.08214588661112823))
    y = y * square + broadcast(_f(-0.5992645293207921))
    y = y * square + broadcast(_f(2.550164039877345))
    y = y * square + broadcast(_f(-5.16771278004997))
    y = y * square + broadcast(_f(3.141592653589793))
    sine = y * part
    y = broadcast(_f(0.0019295743094039))
    y = y * square + broadcast(_f(-0.02580689139001406))
    y = y * square + broadcast(_f(0.2353306303588935))
    y = y * square + broadcast(_f(-1.3352627688545893))
    y = y * square + broadcast(_f(4.058712126416768))
    y = y * square + broadcast(_f(-4.934802200544679))
    y = y * square + broadcast(_f(1.0))
    return (y - sine) * (y + sine), broadcast(_f(2.0)) * sine * y


def _shuffled(builder, a, b, picks):
    return builder.shuffle_vector(a, b, ir.Constant(_INTS, picks))


@_generates(lambda context, a, b, start: VECTOR(VECTOR, VECTOR, start), prefer_literal=True)
def window(context, builder, signature, args):
    """Of the 32 lanes of two vectors one after another, the 16 from a constant `start` on."""
    first = signature.args[2].literal_value
    return _shuffled(builder, *args[:2], [*range(first, first + LANES)])


@_generates(lambda context, array, indices, start: types.UniTuple(VECTOR, 8)(array, indices, types.uint64))
def gather_columns(context, builder, signature, args):
    """The 8 columns of 16 rows of a contiguous float32 array (num, 8): of rows indices[start : start + 16], int32."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    index = context.make_array(signature.args[1])(context, builder, args[1]).data
    half, word = ir.VectorType(ir.FloatType(), 8), ir.IntType(64)
    rows = []
    for k in range(LANES):
        place = builder.gep(index, [builder.add(args[2], ir.Constant(word, k))])
        row = builder.mul(builder.sext(builder.load(place), word), ir.Constant(word, 8))
        rows.append(builder.load(builder.bitcast(builder.gep(data, [row]), half.as_pointer()), align=4))
    pairs = [_shuffled(builder, rows[k], rows[k + 8], [*range(LANES)]) for k in range(8)]
    for bit in (1, 2, 4):  # lanes and rows change places, one bit of their numbers after another
        for k in (k for k in range(8) if not k & bit):
            low, high = pairs[k], pairs[k | bit]
            from_low = [lane if not lane & bit else lane - bit + LANES for lane in range(LANES)]
            from_high = [lane + bit if not lane & bit else lane + LANES for lane in range(LANES)]
            pairs[k], pairs[k | bit] = (_shuffled(builder, low, high, picks) for picks in (from_low, from_high))
    return context.make_tuple(builder, signature.return_type, pairs)


@_generates(lambda context, a, b, c, d: types.UniTuple(VECTOR, 4)(VECTOR, VECTOR, VECTOR, VECTOR))
def transpose_cells(context, builder, signature, args):
    """Four vectors as a 4 x 4 matrix of groups of 4 lanes, transposed: four cells of pixels become four rows of 16."""
    low = [*range(4), *range(16, 20), *range(4, 8), *range(20, 24)]
    high = [*range(8, 12), *range(24, 28), *range(12, 16), *range(28, 32)]
    pairs = [[_shuffled(builder, *two, picks) for picks in (low, high)] for two in (args[:2], args[2:])]
    left, right = [*range(8), *range(16, 24)], [*range(8, 16), *range(24, 32)]
    rows = [_shuffled(builder, pairs[0][k], pairs[1][k], picks) for k in range(2) for picks in (left, right)]
    return context.make_tuple(builder, signature.return_type, rows)


@_generates(lambda context, a, b, width: VECTOR(VECTOR, VECTOR, width), prefer_literal=True)
def add_lanes(context, builder, signature, args):
    """Halfway to the sums of many vectors at once: neighboring groups of `width` lanes (1, 2, 4, 8) added.

    Of each pair of groups, the sum for the first vector takes the first one's place, that for the second vector the
    second one's. After widths 1, 2, 4, 8 over a tree of 16 vectors, lane k of the last holds the sum of vector k.
    """
    number = signature.args[2].literal_value
    first = [k for k in range(LANES) if not k & number]
    even = sorted([(k, k) for k in first] + [(k + number, k + LANES) for k in first])
    odd = sorted([(k, k + number) for k in first] + [(k + number, k + number + LANES) for k in first])
    sides = [_shuffled(builder, *args[:2], [pick for _, pick in picks]) for picks in (even, odd)]
    return builder.fadd(*sides)
