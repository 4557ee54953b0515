//! Ctrl-C that ends steps and keeps what they gave. At other times it ends the program.

use signal_hook::consts::SIGINT;
use signal_hook::flag;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};

/// Exit code of a program that SIGINT ended, as shells report it.
const INTERRUPTED: i32 = 130;

/// What the handler of SIGINT reads and writes; `None` where the system lets a program have none.
static FLAGS: LazyLock<Option<Flags>> = LazyLock::new(|| Flags::register().ok());

struct Flags {
    /// The next Ctrl-C ends the program.
    ends: Arc<AtomicBool>,
    /// There was a Ctrl-C that did not end it.
    noted: Arc<AtomicBool>,
}

impl Flags {
    fn register() -> std::io::Result<Self> {
        let [ends, noted] = [(); 2].map(|()| Arc::new(AtomicBool::new(false)));
        // The actions run in this order: the first Ctrl-C does not find `ends` set.
        flag::register_conditional_shutdown(SIGINT, INTERRUPTED, Arc::clone(&ends))?;
        flag::register(SIGINT, Arc::clone(&ends))?;
        flag::register(SIGINT, Arc::clone(&noted))?;
        Ok(Self { ends, noted })
    }
}

/// Steps that Ctrl-C can end, one at a time. Once this is dropped, Ctrl-C ends the program.
pub struct Interrupt {
    flags: &'static Flags,
}

impl Interrupt {
    /// From now on, the first Ctrl-C is noted, and a second one ends the program. `None` where the system lets a
    /// program have no handler.
    pub fn watch() -> Option<Self> {
        let flags = FLAGS.as_ref()?;
        flags.noted.store(false, Ordering::Relaxed);
        flags.ends.store(false, Ordering::Relaxed);
        Some(Self { flags })
    }

    /// The flag that a Ctrl-C sets.
    pub fn noted(&self) -> &AtomicBool {
        &self.flags.noted
    }
}

impl Drop for Interrupt {
    fn drop(&mut self) {
        self.flags.ends.store(true, Ordering::Relaxed);
    }
}
