//! What a pickle makes.

use tch::Kind;

/// A value's number among [`Values`].
pub(crate) type Id = usize;

/// What a pickle makes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value<'a> {
    /// None, a fraction, or a number that is too long: no field has one.
    Constant,
    Truth(bool),
    Integer(i64),
    Text(&'a str),
    /// A function that makes a tensor.
    Rebuild(Rebuild),
    /// A dict that remembers an order, and is called to be made.
    OrderedDict,
    /// The type of a storage: what its numbers are.
    Dtype(Kind),
    /// Anything else that has a name: a class, most often.
    Named {
        module: &'a str,
        name: &'a str,
    },
    /// Bytes in the file. On which device they were when they were saved doesn't matter.
    Storage {
        dtype: Kind,
        key: &'a str,
    },
    /// A view of a storage, in its elements.
    Tensor {
        storage: Id,
        offset: Id,
        size: Id,
        stride: Id,
    },
    Tuple(Vec<Id>),
    List(Vec<Id>),
    /// Keys and values by turns; of equal keys the last one counts.
    Dict(Vec<Id>),
    /// Data of a class of which nothing is known. If it is a dict, too: keys and values by turns.
    Object(Vec<Id>),
}

/// What makes a tensor of other values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Rebuild {
    /// Of a storage, an offset, a size and a stride; more may follow, such as whether it needs a gradient, and its hooks.
    View,
    /// Of a tensor: a parameter of a model.
    Parameter,
    /// Of what makes a tensor, a class, the arguments for the first, and attributes.
    OfClass,
}

impl Value<'_> {
    /// As errors call it.
    pub fn name(&self) -> &'static str {
        match self {
            Value::Constant | Value::Truth(_) => "a constant",
            Value::Integer(_) => "an integer",
            Value::Text(_) => "a string",
            Value::Rebuild(_) | Value::OrderedDict => "a function",
            Value::Dtype(_) => "a type",
            Value::Named { .. } => "a class or a function",
            Value::Storage { .. } => "a storage",
            Value::Tensor { .. } => "a tensor",
            Value::Tuple(_) => "a tuple",
            Value::List(_) => "a list",
            Value::Dict(_) => "a dict",
            Value::Object(_) => "an object",
        }
    }

    /// The number, of an integer.
    pub fn integer(&self) -> Option<i64> {
        match self {
            &Value::Integer(number) => Some(number),
            _ => None,
        }
    }
}

/// Everything that a pickle made.
#[derive(Debug)]
pub(crate) struct Values<'a> {
    pub(super) values: Vec<Value<'a>>,
    /// What it was made for.
    pub root: Id,
}

impl<'a> Values<'a> {
    /// Value number `id`.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id]
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = &Value<'a>> {
        self.values.iter()
    }

    /// What `items`, keys and values by turns, have under `key`.
    pub fn entry(&self, items: &[Id], key: &str) -> Option<&Value<'a>> {
        let mut pairs = items.chunks_exact(2).rev();
        pairs.find(|pair| self.values[pair[0]] == Value::Text(key)).map(|pair| &self.values[pair[1]])
    }
}
