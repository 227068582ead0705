"""Branch-free exponential and error function that the compiler inlines and vectorises.

The maths library's scalar versions cost 5 to 15 ns a call and stop a loop from being vectorised.
These two cost about 1 ns an element inside a loop, at an absolute error far below what kernels
need. NaN gives NaN.
"""

import numpy as np

from gpom_core.jit import vectorised

_LOG2_E = 1.4426950408889634
_LN_2 = 0.6931471805599453
_ROUND_TO_INTEGER = 6755399441055744.0  # 1.5 * 2^52: adding it leaves round(x) in the low bits
_EXP_UNDERFLOW = -708.0  # below, the power of two would leave the range of normal numbers

_ERF_CLAMP = 4.9  # 1 - erf(4.9) = 4e-12
_ERF_SCALE = 2.0 / _ERF_CLAMP**2  # maps x^2 to v in [-1, 1]


@vectorised
def exp_neg(x: float) -> float:
    """exp(x) for x <= 0, absolute error below 1e-12; exactly 0 below -708.

    Cody-Waite reduction to [-ln2/2, ln2/2] and a minimax polynomial of degree 8.
    Arguments above 0 are accurate to the same relative error up to 708.
    """
    y = _EXP_UNDERFLOW if x < _EXP_UNDERFLOW else x
    shifted = y * _LOG2_E + _ROUND_TO_INTEGER
    r = y - (shifted - _ROUND_TO_INTEGER) * _LN_2
    p = 2.472717625052765e-05
    p = p * r + 0.00019915436150902898
    p = p * r + 0.0013889178811173249
    p = p * r + 0.008333267006715417
    p = p * r + 0.04166666421831926
    p = p * r + 0.16666666885571982
    p = p * r + 0.5000000000618722
    p = p * r + 0.9999999999806087
    p = p * r + 0.9999999999997622
    exponent = np.float64(shifted).view(np.int64) + 1023  # its low bits are the integer part
    power = np.int64(exponent << 52).view(np.float64)
    return 0.0 if x < _EXP_UNDERFLOW else p * power


@vectorised
def erf(x: float) -> float:
    """Error function for any x, exactly odd, absolute error below 1e-11.

    A minimax rational function of degree (8, 8) in x^2, times x, on the clamped argument.
    """
    y = -_ERF_CLAMP if x < -_ERF_CLAMP else x
    y = _ERF_CLAMP if y > _ERF_CLAMP else y
    v = y * y * _ERF_SCALE - 1.0
    p = 6.867158435061265e-05
    p = p * v + 0.0055357095411729335
    p = p * v + 0.06620915005075595
    p = p * v + 0.33242261226279424
    p = p * v + 0.9354944190061837
    p = p * v + 1.6092462398235083
    p = p * v + 1.7111318835580909
    p = p * v + 1.047857072795457
    p = p * v + 0.2886147361293294
    q = 0.0031222252111745546
    q = q * v + 0.07812033273819749
    q = q * v + 0.5961131595194942
    q = q * v + 2.331288103560471
    q = q * v + 5.4761260730597545
    q = q * v + 8.148721438402331
    q = q * v + 7.619122038190065
    q = q * v + 4.130631053818242
    q = q * v + 1.0
    return y * p / q
