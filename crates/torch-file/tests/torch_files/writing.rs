//! Checkpoints that the crate writes. `parity/tests/test_torch_files.py` reads them with torch.

use globalsplat_torch_file::{Array, Dtype, TensorView, TorchFile, Value, write_checkpoint};
use std::collections::HashMap;

const DTYPES: [Dtype; 11] = {
    use Dtype::*;
    [U8, I8, I16, I32, I64, F16, BF16, F32, F64, BOOL, C64]
};

#[test]
fn checkpoints_are_read_as_they_were_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ckpt");
    let contents = DTYPES.map(|dtype| (0..6 * dtype.bitsize() / 8).map(|i| i as u8).collect::<Vec<_>>());
    let names = DTYPES.map(|dtype| format!("a {dtype}"));
    let tensor = |dtype, shape: &[usize], bytes| TensorView::new(dtype, shape.into(), bytes).unwrap();
    let six = DTYPES.into_iter().zip(&contents).map(|(dtype, bytes)| tensor(dtype, &[2, 3], bytes));
    let mut tensors: Vec<(&str, TensorView)> = names.iter().map(String::as_str).zip(six).collect();
    tensors.push(("scalar", tensor(Dtype::F32, &[], &[0, 0, 128, 63])));
    tensors.push(("empty", tensor(Dtype::F32, &[4, 0], &[])));
    let metadata = HashMap::from([("settings".to_string(), "a = \"ä\"\n".to_string())]);
    write_checkpoint(&path, tensors.clone(), &metadata).unwrap();

    let bytes = std::fs::read(&path).unwrap();
    let file = TorchFile::parse(&path, &bytes).unwrap();
    let Value::Dict(root) = file.values.get(file.values.root) else { panic!("no dict") };
    let Some(Value::Dict(state)) = file.values.find(root, "state_dict") else { panic!("no state dict") };
    assert_eq!(state.len(), tensors.len());
    for (name, tensor) in &tensors {
        let value = file.values.find(state, name).unwrap();
        let array = Array::locate(&file.values, &file.storages, value).unwrap();
        assert_eq!((array.dtype, array.shape.as_slice()), (tensor.dtype(), tensor.shape()), "{name}");
        assert!(array.is_contiguous() && bytes[array.bytes.clone()] == *tensor.data(), "{name}");
        assert_eq!(array.bytes.start % 64, 0, "{name}");
    }
    for (key, expected) in [
        ("settings", Value::Str("a = \"ä\"\n")),
        ("pytorch-lightning_version", Value::Str("2.0.0")),
        ("epoch", Value::Int(0)),
        ("global_step", Value::Int(0)),
    ] {
        assert_eq!(file.values.find(root, key), Some(&expected), "{key}");
    }
}

#[test]
fn tensors_that_cannot_be_stored_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ckpt");
    let tensor = TensorView::new(Dtype::U64, vec![1], &[0; 8]).unwrap();
    let error = write_checkpoint(&path, vec![("a", tensor)], &HashMap::new()).unwrap_err();
    assert_eq!(error.to_string(), "tensors of type U64 are not stored");
    assert!(!path.exists());
}
