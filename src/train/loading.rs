//! Threads that make examples ahead of the step.

use super::source::{Augmentation, Example, Source};
use super::{Error, Result};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// How long the step waits before it looks whether anyone still works for it.
const PATIENCE: Duration = Duration::from_secs(2);

/// Examples in the order of their indices, made by threads of their own, at most
/// `ahead` of them waiting.
pub struct Loader {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    next: u64,
}

struct Shared {
    source: Arc<dyn Source>,
    augmentation: (Augmentation, u64),
    ahead: u64,
    stop: AtomicBool,
    queue: Mutex<Queue>,
    changed: Condvar,
}

struct Queue {
    /// First index that nobody has begun.
    begun: u64,
    /// First index that the step has not taken.
    taken: u64,
    done: BTreeMap<u64, Result<Example>>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, queue: MutexGuard<'a, Queue>) -> MutexGuard<'a, Queue> {
        self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        loop {
            let mut queue = self.lock();
            while queue.begun >= queue.taken + self.ahead && !self.stop.load(Ordering::Relaxed) {
                queue = self.wait(queue);
            }
            if self.stop.load(Ordering::Relaxed) {
                return;
            }
            let index = queue.begun;
            queue.begun += 1;
            drop(queue);
            let (augmentation, seed) = &self.augmentation;
            let made = self.source.example(index).map(|e| augmentation.apply(&e, *seed, index));
            self.lock().done.insert(index, made);
            self.changed.notify_all();
        }
    }
}

impl Loader {
    /// Starts `workers` threads at example `first`. Each has a pool of one thread for
    /// itself, so that making pictures does not queue up before the step's own work.
    ///
    /// # Errors
    /// The system gives no thread.
    pub fn start(
        source: Arc<dyn Source>,
        augmentation: (Augmentation, u64),
        (workers, ahead): (usize, usize),
        first: u64,
    ) -> Result<Self> {
        let queue = Queue { begun: first, taken: first, done: BTreeMap::new() };
        let shared = Arc::new(Shared {
            source,
            augmentation,
            ahead: ahead.max(1) as u64,
            stop: AtomicBool::new(false),
            queue: Mutex::new(queue),
            changed: Condvar::new(),
        });
        let mut threads = Vec::new();
        for i in 0..workers.max(1) {
            let shared = shared.clone();
            let body = move || {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
                match pool {
                    Ok(pool) => pool.install(|| shared.work()),
                    Err(_) => shared.work(),
                }
            };
            let thread = std::thread::Builder::new().name(format!("load-{i}")).spawn(body);
            threads.push(thread.map_err(|e| Error::value("threads", "one to load with", e))?);
        }
        Ok(Self { shared, threads, next: first })
    }

    /// Index of the next example.
    pub fn position(&self) -> u64 {
        self.next
    }

    /// The next example; waits for it.
    ///
    /// # Errors
    /// What the source said.
    pub fn take(&mut self) -> Result<Example> {
        let mut queue = self.shared.lock();
        loop {
            if let Some(example) = queue.done.remove(&self.next) {
                self.next += 1;
                queue.taken = self.next;
                drop(queue);
                self.shared.changed.notify_all();
                return example;
            }
            if self.threads.iter().all(JoinHandle::is_finished) {
                return Err(Error::value("loading", "threads that make examples", "none left"));
            }
            let waited = self.shared.changed.wait_timeout(queue, PATIENCE);
            queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        {
            // Under the lock, so that no thread misses it between its look and its wait.
            let _queue = self.shared.lock();
            self.shared.stop.store(true, Ordering::Relaxed);
        }
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}
