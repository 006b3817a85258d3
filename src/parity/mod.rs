//! Rust side of `parity/run.py`: runs any module on given weights and inputs, and returns its outputs and gradients.
//!
//! Nothing is implemented here: every case calls the code that training runs.

mod cases;
mod exchange;

use crate::error::{Error, Result};
use exchange::{Arrays, read_npz, write_npz};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor};

/// Tensors by name.
type Tensors = BTreeMap<String, Tensor>;

/// A parity case to run.
struct Request {
    case: String,
    config: Value,
    params: Tensors,
    inputs: Tensors,
    cotangents: Tensors,
    device: Device,
}

/// Result of a case, before the backward pass: its outputs, and the trainable parameters.
struct Answer {
    outputs: Tensors,
    params: Tensors,
}

/// Runs every request `*.npz` in `requests` and writes a file of the same name to `responses`. Returns the number of requests.
///
/// # Errors
/// Fails if a folder or file can't be read or written. If a case fails, its response holds the error message.
pub fn answer_all(requests: &Path, responses: &Path, device: Device) -> Result<usize> {
    let mut files: Vec<PathBuf> = vec![];
    for entry in std::fs::read_dir(requests).map_err(Error::read(requests))? {
        let path = entry.map_err(Error::read(requests))?.path();
        if path.extension().is_some_and(|ending| ending == "npz") {
            files.push(path);
        }
    }
    files.sort();
    for file in &files {
        let arrays = match answer(file, device) {
            Ok(arrays) => arrays,
            Err(error) => Arrays::from([("error".into(), text_array(&error.to_string()))]),
        };
        write_npz(&responses.join(file.file_name().expect("a file's name")), &arrays)?;
    }
    Ok(files.len())
}

fn answer(file: &Path, device: Device) -> Result<Arrays> {
    let request = read_request(file, device)?;
    let answer = cases::run(&request)?;
    let mut arrays = Arrays::new();
    for (name, output) in &answer.outputs {
        arrays.insert(format!("out.{name}"), output.detach().to_device(Device::Cpu));
    }
    if request.cotangents.is_empty() {
        return Ok(arrays);
    }
    let mut objective = Tensor::zeros([], (Kind::Double, device));
    for (name, cotangent) in &request.cotangents {
        let output = answer.outputs.get(name).ok_or_else(|| unknown(file, "output", name))?;
        objective = &objective + (output * cotangent).sum(Kind::Double);
    }
    objective.backward();
    let gradient = |t: &Tensor| match t.grad() {
        gradient if gradient.defined() => gradient.to_device(Device::Cpu),
        _ => t.detach().zeros_like().to_device(Device::Cpu),
    };
    for (name, parameter) in &answer.params {
        arrays.insert(format!("grad.param.{name}"), gradient(parameter));
    }
    for (name, input) in request.inputs.iter().filter(|(_, input)| input.requires_grad()) {
        arrays.insert(format!("grad.in.{name}"), gradient(input));
    }
    Ok(arrays)
}

fn read_request(file: &Path, device: Device) -> Result<Request> {
    let mut arrays = read_npz(file)?;
    let case = arrays.remove("case").ok_or_else(|| unknown(file, "array", "case"))?;
    let case = String::from_utf8_lossy(&Vec::<u8>::try_from(case)?).into_owned();
    let case: Value = serde_json::from_str(&case)
        .map_err(|e| Error::input(file, "case", format!("no JSON ({e})"), "{\"case\", \"config\"}"))?;
    let differentiate: Vec<&str> =
        case["differentiate"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    let mut request = Request {
        case: case["case"].as_str().unwrap_or_default().to_string(),
        config: case["config"].clone(),
        params: Tensors::new(),
        inputs: Tensors::new(),
        cotangents: Tensors::new(),
        device,
    };
    for (name, array) in arrays {
        let (kind, name) = name.split_once('.').ok_or_else(|| unknown(file, "array", &name))?;
        let tensor = array.to_device(device);
        match kind {
            "param" => request.params.insert(name.into(), tensor),
            "in" => {
                let tensor = tensor.set_requires_grad(differentiate.contains(&name));
                request.inputs.insert(name.into(), tensor)
            }
            "cot" => request.cotangents.insert(name.into(), tensor),
            _ => return Err(unknown(file, "array", kind)),
        };
    }
    Ok(request)
}

fn unknown(file: &Path, what: &str, name: &str) -> Error {
    Error::input(file, format!("{what} {name}"), "out of place", "what parity/run.py writes")
}

fn text_array(text: &str) -> Tensor {
    Tensor::from_slice(text.as_bytes())
}
