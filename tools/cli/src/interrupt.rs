//! Ctrl-C that ends steps and keeps what they gave. At other times it ends the program.

use signal_hook::consts::SIGINT;
use signal_hook::flag;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};

/// Exit code of a program that SIGINT ended, as shells report it.
const INTERRUPTED: i32 = 130;

static FLAGS: LazyLock<Flags> = LazyLock::new(|| {
    let flags = Flags::default();
    // Where the system refuses a handler, Ctrl-C ends the program as before, and no flag is set.
    let _ = flags.register();
    flags
});

/// Flags of the handler of SIGINT.
#[derive(Default)]
struct Flags {
    /// The next Ctrl-C ends the program.
    ends: Arc<AtomicBool>,
    /// There was a Ctrl-C that did not end it.
    noted: Arc<AtomicBool>,
}

impl Flags {
    fn register(&self) -> std::io::Result<()> {
        // The actions run in this order: the first Ctrl-C does not find `ends` set.
        flag::register_conditional_shutdown(SIGINT, INTERRUPTED, Arc::clone(&self.ends))?;
        flag::register(SIGINT, Arc::clone(&self.ends))?;
        flag::register(SIGINT, Arc::clone(&self.noted))?;
        Ok(())
    }
}

/// Steps that Ctrl-C can end, one at a time. Once this is dropped, Ctrl-C ends the program.
pub struct Interrupt(());

impl Interrupt {
    /// From now on, the first Ctrl-C is noted, and a second one ends the program.
    pub fn watch() -> Self {
        FLAGS.noted.store(false, Ordering::Relaxed);
        FLAGS.ends.store(false, Ordering::Relaxed);
        Self(())
    }

    /// The flag that a Ctrl-C sets.
    pub fn flag(&self) -> &AtomicBool {
        &FLAGS.noted
    }

    /// Returns whether there was a Ctrl-C.
    pub fn is_noted(&self) -> bool {
        self.flag().load(Ordering::Relaxed)
    }
}

impl Drop for Interrupt {
    fn drop(&mut self) {
        FLAGS.ends.store(true, Ordering::Relaxed);
    }
}
