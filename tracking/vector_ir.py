"""Integer inner loops of the correlator as LLVM vector instructions, for int8 samples on x86 processors with AVX2.

numba does not find the multiply-add of 16-bit pairs (vpmaddwd, with VNNI vpdpwssd) in loops that use a sample twice, so
these loops are written as LLVM IR, 16 samples at a time. Arithmetic, exact in integers:

    u = round(2^7 (x c + y s)), v = round(2^7 (y c - x s)),  c, s in units of 2^-14, each product rounded on its own;
    sums of u p and v p in 32 bits: 1024 samples of at most 2^7 128 sqrt(2) times +-1 fit with room, and
    ``LONGEST_MULTILEVEL`` samples times code levels of at most 127.

Where AVX2 is absent, ``HAS_INTEGER_PATH`` is false and ``kernels`` uses its single-precision loops, which agree to
about -90 dB.
"""

import platform

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = [
    "HAS_INTEGER_PATH",
    "INTEGER_SCALE",
    "TABLE_ONE",
    "WIDTH",
    "dot3",
    "dot4",
    "dot5",
    "dot6",
    "fused4",
    "wipe",
]

TABLE_ONE = 16384.0
"""One, in the units of the integer carrier table."""
INTEGER_SCALE = 128.0
"""One unit of sample x code, in the sums."""
LONGEST_MULTILEVEL = 704
"""Most samples of a block where code levels go up to 127: 704 x 2^7 128 sqrt(2) x 127 < 2^31."""
WIDTH = 16
"""Samples per step; the caller treats the remainder."""


def _has_avx2():
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    try:
        return bool(llvm.get_host_cpu_features().get("avx2", False))
    except RuntimeError:
        return False


HAS_INTEGER_PATH = _has_avx2()

_I8, _I16, _I32, _I64 = (ir.IntType(n) for n in (8, 16, 32, 64))
_V8, _V16, _V32 = (ir.VectorType(t, n) for t, n in ((_I8, WIDTH), (_I16, WIDTH), (_I32, WIDTH // 2)))


def _load(builder, address, vector, align=1):
    return builder.load(builder.inttoptr(address, vector.as_pointer()), align=align)


def _load_wide(builder, address):
    """Sixteen int8 as int16."""
    return builder.sext(_load(builder, address, _V8), _V16)


def _call(builder, name, result, *args):
    kind = ir.FunctionType(result, [a.type for a in args])
    return builder.call(builder.module.declare_intrinsic(name, fnty=kind), args)


def _wiped(builder, xi, xq, ct, st, k):
    """u and v of samples 16 k .. 16 k + 15."""
    k16 = builder.shl(k, ir.Constant(_I64, 4))
    k32 = builder.shl(k, ir.Constant(_I64, 5))
    eight = ir.Constant(_V16, [8] * WIDTH)
    x = builder.shl(_load_wide(builder, builder.add(xi, k16)), eight)
    y = builder.shl(_load_wide(builder, builder.add(xq, k16)), eight)
    c, s = _load(builder, builder.add(ct, k32), _V16), _load(builder, builder.add(st, k32), _V16)

    def times(a, b):
        return _call(builder, "llvm.x86.avx2.pmul.hr.sw", _V16, a, b)

    u = builder.add(times(x, c), times(y, s))
    v = builder.sub(times(y, c), times(x, s))
    return u, v


def _loop(builder, steps, initial, body):
    """for k in range(steps): state = body(k, state); ``state`` a list of vectors -> the final one."""
    before = builder.block
    head = builder.append_basic_block("head")
    inside = builder.append_basic_block("inside")
    after = builder.append_basic_block("after")
    builder.branch(head)
    builder.position_at_end(head)
    k = builder.phi(_I64)
    state = [builder.phi(value.type) for value in initial]
    k.add_incoming(ir.Constant(_I64, 0), before)
    for phi, value in zip(state, initial):
        phi.add_incoming(value, before)
    builder.cbranch(builder.icmp_signed("<", k, steps), inside, after)
    builder.position_at_end(inside)
    new = body(k, state)
    k.add_incoming(builder.add(k, ir.Constant(_I64, 1)), builder.block)
    for phi, value in zip(state, new):
        phi.add_incoming(value, builder.block)
    builder.branch(head)
    builder.position_at_end(after)
    return state


def _accumulate(builder, state, u, v, taps, k):
    """Multiply-add the code values of every tap."""
    k16 = builder.shl(k, ir.Constant(_I64, 4))
    new = []
    for t, base in enumerate(taps):
        p = _load_wide(builder, builder.add(base, k16))
        for j, w in enumerate((u, v)):
            products = _call(builder, "llvm.x86.avx2.pmadd.wd", _V32, w, p)
            new.append(builder.add(state[2 * t + j], products))
    return new


def _addresses(builder, pool, starts, n_taps):
    out = []
    for t in range(n_taps):
        address = builder.inttoptr(builder.add(starts, ir.Constant(_I64, 8 * t)), _I64.as_pointer())
        out.append(builder.add(pool, builder.load(address)))
    return out


def _store_sums(builder, state, out):
    reduce_type = ir.FunctionType(_I32, [_V32])
    reduce = builder.module.declare_intrinsic("llvm.vector.reduce.add.v8i32", fnty=reduce_type)
    for j, vector in enumerate(state):
        address = builder.inttoptr(builder.add(out, ir.Constant(_I64, 4 * j)), _I32.as_pointer())
        builder.store(builder.call(reduce, [vector]), address)


def _zeros(n):
    return [ir.Constant(_V32, [0] * (WIDTH // 2)) for _ in range(n)]


def _fused(n_taps):
    """Intrinsic (xi, xq, cos, sin, pool, starts, steps, out), all int64: addresses, and the number of steps.

    Wipes off the carrier and sums ``n_taps`` taps in one pass; ``out`` int32 (2 n_taps,), I and Q interleaved.
    """

    @intrinsic
    def fused(typingctx, xi, xq, ct, st, pool, starts, steps, out):
        def codegen(context, builder, signature, args):
            xi, xq, ct, st, pool, starts, steps, out = args
            taps = _addresses(builder, pool, starts, n_taps)

            def body(k, state):
                u, v = _wiped(builder, xi, xq, ct, st, k)
                return _accumulate(builder, state, u, v, taps, k)

            _store_sums(builder, _loop(builder, steps, _zeros(2 * n_taps), body), out)
            return context.get_dummy_value()

        return types.void(*([types.int64] * 8)), codegen

    return fused


def _dot(n_taps):
    """Intrinsic (wi, wq, pool, starts, steps, out): taps of samples that ``wipe`` has turned to int16."""

    @intrinsic
    def dot(typingctx, wi, wq, pool, starts, steps, out):
        def codegen(context, builder, signature, args):
            wi, wq, pool, starts, steps, out = args
            taps = _addresses(builder, pool, starts, n_taps)

            def body(k, state):
                k32 = builder.shl(k, ir.Constant(_I64, 5))
                u = _load(builder, builder.add(wi, k32), _V16)
                v = _load(builder, builder.add(wq, k32), _V16)
                return _accumulate(builder, state, u, v, taps, k)

            _store_sums(builder, _loop(builder, steps, _zeros(2 * n_taps), body), out)
            return context.get_dummy_value()

        return types.void(*([types.int64] * 6)), codegen

    return dot


@intrinsic
def wipe(typingctx, xi, xq, ct, st, steps, wi, wq):
    """Intrinsic (xi, xq, cos, sin, steps, wi, wq): wiped samples u, v as int16."""

    def codegen(context, builder, signature, args):
        xi, xq, ct, st, steps, wi, wq = args

        def body(k, state):
            u, v = _wiped(builder, xi, xq, ct, st, k)
            k32 = builder.shl(k, ir.Constant(_I64, 5))
            for base, vector in ((wi, u), (wq, v)):
                builder.store(vector, builder.inttoptr(builder.add(base, k32), _V16.as_pointer()), align=1)
            return []

        _loop(builder, steps, [], body)
        return context.get_dummy_value()

    return types.void(*([types.int64] * 7)), codegen


# Two accumulators per tap, samples and code values fit the 16 registers of AVX2 up to 4 and 6 taps.
fused4 = _fused(4)
dot3, dot4, dot5, dot6 = (_dot(n) for n in (3, 4, 5, 6))
