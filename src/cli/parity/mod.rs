//! Rust side of `python parity/run.py`: runs any module on given weights and inputs, and returns its outputs and gradients.
//!
//! Nothing is implemented here: every case calls the code that training runs.

mod cases;

use super::device;
use crate::error::{Error, Result};
use clap::Args;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor};

/// Answer the requests of `python parity/run.py`.
#[derive(Args)]
pub struct Parity {
    /// Folder of request files
    #[arg(long, value_name = "DIR")]
    requests: PathBuf,
    /// Folder for the responses
    #[arg(long, value_name = "DIR")]
    responses: PathBuf,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

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

impl Parity {
    /// Answers every request `*.safetensors` by a file of the same name. If a case fails, its response holds the error message.
    pub fn run(self) -> anyhow::Result<()> {
        let device = device::parse(&self.device)?;
        let mut files = vec![];
        for entry in std::fs::read_dir(&self.requests).map_err(Error::read(&self.requests))? {
            files.push(entry.map_err(Error::read(&self.requests))?.path());
        }
        files.retain(|path| path.extension().is_some_and(|ending| ending == "safetensors"));
        files.sort();
        for file in &files {
            let arrays = answer(file, device).unwrap_or_else(|error| {
                Tensors::from([("error".into(), Tensor::from_slice(error.to_string().as_bytes()))])
            });
            let arrays: Vec<_> = arrays.into_iter().map(|(name, t)| (name, t.contiguous())).collect();
            let response = self.responses.join(file.file_name().expect("a file's name"));
            Tensor::write_safetensors(&arrays, response)?;
        }
        Ok(())
    }
}

fn answer(file: &Path, device: Device) -> Result<Tensors> {
    let request = read_request(file, device)?;
    let answer = cases::run(&request)?;
    let mut arrays = Tensors::new();
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
    let mut arrays: Tensors = Tensor::read_safetensors(file).map_err(Error::external)?.into_iter().collect();
    let case = arrays.remove("case").ok_or_else(|| unknown(file, "array", "case"))?;
    let case = String::from_utf8_lossy(&Vec::<u8>::try_from(case).map_err(Error::external)?).into_owned();
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
    Error::input(file, format!("{what} {name}"), "out of place", "what parity/harness writes")
}
