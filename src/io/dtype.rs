//! Conversion between the types of tensors in files and libtorch's.

use crate::error::{Error, Result};
use globalsplat_torch_file::Dtype;
use tch::Kind;

/// Types that files and libtorch share.
const DTYPES: [(Dtype, Kind); 15] = [
    (Dtype::U8, Kind::Uint8),
    (Dtype::I8, Kind::Int8),
    (Dtype::I16, Kind::Int16),
    (Dtype::I32, Kind::Int),
    (Dtype::I64, Kind::Int64),
    (Dtype::F16, Kind::Half),
    (Dtype::BF16, Kind::BFloat16),
    (Dtype::F32, Kind::Float),
    (Dtype::F64, Kind::Double),
    (Dtype::Bool, Kind::Bool),
    (Dtype::C64, Kind::ComplexFloat),
    (Dtype::C128, Kind::ComplexDouble),
    (Dtype::QI8, Kind::QInt8),
    (Dtype::QU8, Kind::QUInt8),
    (Dtype::QI32, Kind::QInt32),
];

/// Returns libtorch's name of `dtype`.
pub(super) fn to_kind(dtype: Dtype) -> Kind {
    DTYPES.iter().find(|(d, _)| *d == dtype).expect("every type").1
}

/// Returns the type of `kind` in a file.
///
/// # Errors
/// Returns an error if files have no such type.
pub(super) fn to_dtype(kind: Kind) -> Result<Dtype> {
    let dtype = DTYPES.iter().find(|(_, k)| *k == kind).map(|(dtype, _)| *dtype);
    dtype.ok_or_else(|| Error::failed(format!("tensors of kind {kind:?} are not stored")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_torch_file::Array;
    use tch::Tensor;

    #[test]
    fn sizes_match_libtorch() {
        for (dtype, kind) in DTYPES {
            assert_eq!(dtype.size(), kind.elt_size_in_bytes(), "{dtype}");
            assert_eq!((to_kind(dtype), to_dtype(kind).unwrap()), (kind, dtype));
        }
        assert!(to_dtype(Kind::ComplexHalf).is_err());
    }

    /// Every number of 16 bits, and numbers of 64 bits around the limits of float32 and between two of its values.
    #[test]
    fn numbers_are_rounded_as_by_libtorch() {
        let words: Vec<u8> = (0..=u16::MAX).flat_map(u16::to_le_bytes).collect();
        let mantissas = [0u64, 1, 0x1000_0000, 0x1000_0001, 0x2fff_ffff, 0x3000_0000, 0xf_ffff_f000_0000];
        let doubles: Vec<u8> = (0..4096u64)
            .flat_map(|top| mantissas.map(|mantissa| top << 52 | mantissa))
            .flat_map(u64::to_le_bytes)
            .collect();
        for (dtype, bytes) in [(Dtype::F16, &words), (Dtype::BF16, &words), (Dtype::F64, &doubles)] {
            let count = bytes.len() / dtype.size();
            let array = Array { dtype, shape: vec![count], strides: vec![1], bytes: 0..bytes.len() };
            let found = array.to_f32(bytes).unwrap();
            let tensor = Tensor::from_data_size(bytes, &[count as i64], to_kind(dtype));
            let expected = Vec::<f32>::try_from(tensor.to_kind(Kind::Float)).unwrap();
            for (found, expected) in found.into_iter().zip(expected) {
                assert_eq!(found.to_bits(), expected.to_bits(), "{dtype}: {found}, {expected}");
            }
        }
    }
}
