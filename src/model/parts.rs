//! What a pass is doing, told to who wants to know: every product, norm and sum belongs to a part.

use std::cell::RefCell;
use tch::Tensor;

/// A step of a pass.
#[derive(Debug, Clone, Copy)]
pub enum Event {
    /// A part begins. Parts don't overlap: one within another is none of its own.
    Begins(&'static str),
    /// It is over.
    Ends,
    /// What the part that is under way does.
    Does {
        /// In products.
        flops: f64,
        /// In products of the backward pass, where it will be followed.
        owed: f64,
        /// Of numbers that come in and go out.
        bytes: f64,
    },
}

struct Listener {
    tell: Box<dyn FnMut(Event)>,
    is_within: bool,
}

thread_local! {
    static LISTENER: RefCell<Option<Listener>> = const { RefCell::new(None) };
}

/// Does `pass`, of which this thread tells `listener` every event.
pub fn told<T>(listener: impl FnMut(Event) + 'static, pass: impl FnOnce() -> T) -> T {
    LISTENER.set(Some(Listener { tell: Box::new(listener), is_within: false }));
    let result = pass();
    LISTENER.set(None);
    result
}

/// Does `work`, which is a part.
pub(crate) fn part<T>(name: &'static str, work: impl FnOnce() -> T) -> T {
    let begins = LISTENER.with_borrow_mut(|listener| match listener {
        Some(listener) if !listener.is_within => {
            listener.is_within = true;
            (listener.tell)(Event::Begins(name));
            true
        }
        _ => false,
    });
    let result = work();
    if begins {
        LISTENER.with_borrow_mut(|listener| {
            if let Some(listener) = listener {
                listener.is_within = false;
                (listener.tell)(Event::Ends);
            }
        });
    }
    result
}

/// Tells of `flops` that are done on `tensors`, which come in or go out, and of those that their gradients will take.
pub(super) fn does(flops: i64, owed: i64, tensors: &[&Tensor]) {
    LISTENER.with_borrow_mut(|listener| {
        if let Some(listener) = listener.as_mut().filter(|listener| listener.is_within) {
            let bytes: usize = tensors.iter().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum();
            (listener.tell)(Event::Does { flops: flops as f64, owed: owed as f64, bytes: bytes as f64 });
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::rc::Rc;
    use tch::{Device, Kind};

    #[test]
    fn a_part_within_another_is_none_of_its_own() {
        let said = Rc::new(RefCell::new(vec![]));
        let numbers = Tensor::zeros([3, 5], (Kind::BFloat16, Device::Cpu));
        let pass = || {
            does(7, 0, &[&numbers]);
            part("outer", || part("inner", || does(2, 3, &[&numbers, &numbers])));
            part("next", || 4)
        };
        let to = said.clone();
        assert_eq!(told(move |event| to.borrow_mut().push(format!("{event:?}")), pass), 4);
        let expected = [
            "Begins(\"outer\")",
            "Does { flops: 2.0, owed: 3.0, bytes: 60.0 }",
            "Ends",
            "Begins(\"next\")",
            "Ends",
        ];
        assert_eq!(*said.borrow(), expected);
        assert_eq!(part("unheard", || 5), 5);
        assert_eq!(said.borrow().len(), expected.len());
    }
}
