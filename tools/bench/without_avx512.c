/* Hides AVX-512 and AMX from the programs that load this library (without_avx512.sh).
 *
 * The kernel makes CPUID fault in user space; the handler executes it and clears the bits. x86-64
 * Linux on processors with CPUID faulting (Intel since Ivy Bridge). */

#define _GNU_SOURCE
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <ucontext.h>
#include <unistd.h>

/* asm/prctl.h */
#define ARCH_SET_CPUID 0x1012

/* Bits of leaf 7, "structured extended features" (Intel SDM, CPUID). */
static const uint32_t EBX = 1u << 16 | 1u << 17 | 1u << 21 | 1u << 26 | 1u << 27 | 1u << 28 | 1u << 30 | 1u << 31;
static const uint32_t ECX = 1u << 1 | 1u << 6 | 1u << 11 | 1u << 12 | 1u << 14;
static const uint32_t EDX = 1u << 2 | 1u << 3 | 1u << 8 | 1u << 22 | 1u << 23 | 1u << 24 | 1u << 25;
/* Of subleaf 1: AVX512_BF16, AMX-FP16. */
static const uint32_t EAX_1 = 1u << 5 | 1u << 21;

static struct sigaction before;

static long set_cpuid(int allowed) {
    return syscall(SYS_arch_prctl, ARCH_SET_CPUID, allowed);
}

static void on_fault(int number, siginfo_t *info, void *context) {
    greg_t *r = ((ucontext_t *)context)->uc_mcontext.gregs;
    const uint8_t *at = (const uint8_t *)r[REG_RIP];
    (void)number;
    (void)info;
    if (at[0] != 0x0f || at[1] != 0xa2) {
        /* Another fault: it happens again, under the handler of before. */
        sigaction(SIGSEGV, &before, 0);
        return;
    }
    uint32_t leaf = r[REG_RAX], sub = r[REG_RCX], a, b, c, d;
    set_cpuid(1);
    __asm__ volatile("cpuid" : "=a"(a), "=b"(b), "=c"(c), "=d"(d) : "a"(leaf), "c"(sub));
    set_cpuid(0);
    if (leaf == 7 && sub == 0) {
        b &= ~EBX;
        c &= ~ECX;
        d &= ~EDX;
    } else if (leaf == 7 && sub == 1) {
        a &= ~EAX_1;
    }
    r[REG_RAX] = a;
    r[REG_RBX] = b;
    r[REG_RCX] = c;
    r[REG_RDX] = d;
    r[REG_RIP] += 2;
}

__attribute__((constructor)) static void start(void) {
    struct sigaction action = {0};
    action.sa_sigaction = on_fault;
    action.sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK;
    sigaction(SIGSEGV, &action, &before);
    if (set_cpuid(0) != 0) {
        fputs("without_avx512: expected a processor and a kernel with CPUID faulting\n", stderr);
        _exit(1);
    }
}
