//! Types of tensors' elements.

use std::fmt;

/// Type of a tensor's elements. Names follow safetensors, where it has the type. [`fmt::Display`] prints the name of the variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dtype {
    /// 8-bit unsigned integer, `torch.uint8`.
    U8,
    /// 8-bit signed integer, `torch.int8`.
    I8,
    /// 16-bit signed integer, `torch.int16`.
    I16,
    /// 32-bit signed integer, `torch.int32`.
    I32,
    /// 64-bit signed integer, `torch.int64`.
    I64,
    /// 16-bit floating-point number of IEEE 754, `torch.float16`.
    F16,
    /// 16-bit floating-point number with the exponent of [`Dtype::F32`], `torch.bfloat16`.
    BF16,
    /// 32-bit floating-point number, `torch.float32`.
    F32,
    /// 64-bit floating-point number, `torch.float64`.
    F64,
    /// Boolean in one byte, `torch.bool`.
    Bool,
    /// Complex number of two [`Dtype::F32`], `torch.complex64`.
    C64,
    /// Complex number of two [`Dtype::F64`], `torch.complex128`.
    C128,
    /// 8-bit signed quantized integer, `torch.qint8`.
    QI8,
    /// 8-bit unsigned quantized integer, `torch.quint8`.
    QU8,
    /// 32-bit signed quantized integer, `torch.qint32`.
    QI32,
}

/// Classes of the module `torch` for storages, by the type of their elements.
const STORAGES: [(Dtype, &str); 15] = [
    (Dtype::U8, "ByteStorage"),
    (Dtype::I8, "CharStorage"),
    (Dtype::I16, "ShortStorage"),
    (Dtype::I32, "IntStorage"),
    (Dtype::I64, "LongStorage"),
    (Dtype::F16, "HalfStorage"),
    (Dtype::BF16, "BFloat16Storage"),
    (Dtype::F32, "FloatStorage"),
    (Dtype::F64, "DoubleStorage"),
    (Dtype::Bool, "BoolStorage"),
    (Dtype::C64, "ComplexFloatStorage"),
    (Dtype::C128, "ComplexDoubleStorage"),
    (Dtype::QI8, "QInt8Storage"),
    (Dtype::QU8, "QUInt8Storage"),
    (Dtype::QI32, "QInt32Storage"),
];

impl Dtype {
    /// Returns the size of an element in bytes.
    pub fn size(self) -> usize {
        match self {
            Dtype::U8 | Dtype::I8 | Dtype::Bool | Dtype::QI8 | Dtype::QU8 => 1,
            Dtype::I16 | Dtype::F16 | Dtype::BF16 => 2,
            Dtype::I32 | Dtype::F32 | Dtype::QI32 => 4,
            Dtype::I64 | Dtype::F64 | Dtype::C64 => 8,
            Dtype::C128 => 16,
        }
    }

    /// Returns `true` if the elements are real floating-point numbers.
    pub fn is_float(self) -> bool {
        matches!(self, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64)
    }

    /// Returns `true` if the elements are quantized: a tensor needs a scale and a zero point beside them.
    pub fn is_quantized(self) -> bool {
        matches!(self, Dtype::QI8 | Dtype::QU8 | Dtype::QI32)
    }

    /// Returns the name of the class of the module `torch` for storages of this type.
    pub(crate) fn storage_class(self) -> &'static str {
        STORAGES.iter().find(|(dtype, _)| *dtype == self).expect("every type").1
    }

    /// Returns the type of the elements of a storage of the class `name` of the module `torch`.
    pub(crate) fn from_storage_class(name: &str) -> Option<Self> {
        STORAGES.iter().find(|(_, class)| *class == name).map(|(dtype, _)| *dtype)
    }
}

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}
